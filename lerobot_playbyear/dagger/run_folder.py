"""The output folder of a run: options, checkpoints, figures and counters that survive being killed at any moment.

`dagger_state.json` is the truth: it is replaced as a whole after every attempt, and names the checkpoint that belongs to
it. A checkpoint is written beside its place, put on the disk and renamed before the state names it. Only checkpoints that the
state names are ever removed, and nothing is written or removed through a link.
"""

import contextlib
import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import ParsingError
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK
from safetensors import SafetensorError

from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig
from lerobot_playbyear.dagger.robot_gated import ATTEMPTS
from lerobot_playbyear.datasets.errors import InputError, first_line
from lerobot_playbyear.datasets.files import (
    PARTIAL,
    FolderLock,
    append_line,
    check_can_be_made,
    check_no_links,
    is_trial,
    new_folder,
    parse_json,
    replace_link,
    write_atomically,
)
from lerobot_playbyear.hub.push import METRICS_NAME, RUN_FOLDERS, read_metrics

STATE_NAME = "dagger_state.json"
"""File in the output folder with the counters of the run and the name of its checkpoint."""

BEST_LINK = "best"
"""Name of the link to the checkpoint of the best evaluation."""

LOCK = ".lock"
"""File in the output folder while a run is at work."""

_NAME = re.compile(r"[0-9]+")  # of a checkpoint's folder: one that leads nowhere else, and is no link's

_COUNTS = ("round", "step", "attempts", "kept", "failed", "unneeded", "discarded", "next_seed")
_BEST = {"success": int | float, "seeds": list, "checkpoint": str | None}

_SAME_RUN = (
    *("dataset", "interventions", "env", "expert", "method", "skip_s", "new_weights", "seed"),
    *("episode_seed", "warmup_episodes", "rename_map"),
)
"""Options that stay as they are when a run goes on."""


@dataclass
class RunState:
    """How far a run is.

    Attributes:
        policy_path: The policy that the run began with.
        policy_overrides: Its options on the command line.
        first_episodes: Attempts that the intervention dataset held when the run began; None before.
        round: Rounds done: a kept attempt and the updates after it, or, without collecting, only updates.
        step: Updates done.
        attempts: Attempts made.
        kept, failed, unneeded, discarded: What became of them: solved with the expert's help; not solved; solved without
            it; ended by the expert as void.
        next_seed: Of the next attempt.
        to_show: The seed of an attempt that failed, whose scene the expert demonstrates next; None otherwise.
        fruitless: What became of the attempts since the last that was kept, but for those in which nobody could help.
        evaluated_round: The round after which the last evaluation took place; -1 for none.
        evaluated_step: Updates that there had been; -1 for none.
        evaluated_episodes: How many it had; None before.
        success: What it gave [%].
        best: The best evaluation on the present seeds: its `success` [%], its `seeds` (first, number), and the `checkpoint`
            that it was of, None for the policy that the run began with. Empty before, and where that checkpoint was removed.
        checkpoint: Folder of the newest weights; None before the first update.
        milestones: Checkpoints that are kept for good.
        made: Checkpoints that this run has written and not removed; no other folder is ever removed.
        method: What the method keeps.
        wandb_run_id: To go on with the same run there.
    """

    policy_path: str
    policy_overrides: list[str] = field(default_factory=list)
    first_episodes: int | None = None
    round: int = 0
    step: int = 0
    attempts: int = 0
    kept: int = 0
    failed: int = 0
    unneeded: int = 0
    discarded: int = 0
    next_seed: int = 0
    to_show: int | None = None
    fruitless: list[str] = field(default_factory=list)
    evaluated_round: int = -1
    evaluated_step: int = -1
    evaluated_episodes: int | None = None
    success: float | None = None
    best: dict[str, Any] = field(default_factory=dict)
    checkpoint: str | None = None
    milestones: list[str] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    method: dict[str, Any] = field(default_factory=dict)
    wandb_run_id: str | None = None


class RunFolder:
    """Reads and writes the output folder.

    Args:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.checkpoints = self.path / CHECKPOINTS_DIR

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Makes this process the only one that works in the folder. Of a run that never began nothing remains.

        Raises:
            InputError: It cannot be written.
            FolderLockedError: Another process works in it.
        """
        check_can_be_made(self.path, f"--output_dir={self.path}")
        in_use = f"--output_dir={self.path}: another playbyear-dagger is at work there. Wait, or choose another."
        is_new = not self.path.exists()
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(FolderLock(self.path / LOCK, in_use))
            except OSError as error:
                logging.warning(f"{self.path} cannot be locked ({error}): let no other playbyear-dagger work there.")
            stack.callback(self._leave_nothing, is_new)
            yield

    def _leave_nothing(self, is_new: bool) -> None:
        """Removes what was made for a run that did not begin."""
        if (self.path / CONFIG_NAME).exists():
            return
        with contextlib.suppress(OSError):  # no lock was there, or Windows removes no open file, or others are there
            (self.path / LOCK).unlink()
            if is_new:
                self.path.rmdir()

    def claim(self, resume: bool, interventions: Path) -> RunState | None:
        """Find out whether there is a run to go on with.

        Args:
            resume: Whether that is wanted.
            interventions: Folder of the attempts, which may lie in this one, and may have been made before the run began.

        Returns:
            The state of the run, or None when a new one begins.

        Raises:
            InputError: The folder holds a run and `resume` is off, or it holds something else, or a link where the run writes;
                or its state is damaged or missing.
        """
        check_no_links(self.path, METRICS_NAME, ATTEMPTS, *RUN_FOLDERS)
        here, own = self.path.resolve(), interventions.resolve()
        paths = [path for path in self.path.iterdir() if not is_trial(path.name)] if self.path.exists() else []
        names = {path.name for path in paths if here / path.name not in (own, *own.parents)}
        if names <= {LOCK, CONFIG_NAME + PARTIAL}:  # of a run that could not write even its options
            return None
        if not (self.path / CONFIG_NAME).is_file():
            raise InputError(
                f"--output_dir={self.path} holds files, but no run of playbyear-dagger (no {CONFIG_NAME}): choose another."
            )
        if not resume:
            raise InputError(f"--output_dir={self.path} holds a run already: give --resume=true, or choose another.")
        path = self.path / STATE_NAME
        if not path.is_file():
            if self.metrics() or self.checkpoints.exists():  # the state is written before them
                raise InputError(f"{path} is missing: put it back from a copy, or choose another --output_dir.")
            return None
        try:
            state = draccus.decode(RunState, parse_json(path.read_bytes()))
            if negative := [name for name in _COUNTS if getattr(state, name) < 0]:
                raise ValueError(f"{negative[0]} is {getattr(state, negative[0])}; wanted 0 or more")
            if state.best and not all(isinstance(state.best.get(name, ...), kind) for name, kind in _BEST.items()):
                raise ValueError(f"best is {state.best}; wanted {', '.join(_BEST)}")
        except (ValueError, ParsingError) as error:
            raise InputError(
                f"{path} is damaged: {first_line(error)}. Put it back from a copy, or begin another run with the corrections "
                "that are there, in another --output_dir."
            ) from error
        said = [*state.made, *state.milestones, state.checkpoint, state.best.get("checkpoint")]
        if strange := [name for name in said if name is not None and not _NAME.fullmatch(name)]:
            raise InputError(f"{path} names the checkpoint {strange[0]!r}; wanted folders in '{self.checkpoints}'.")
        return state

    def begin(self, cfg: DaggerConfig, state: RunState) -> None:
        """Make the folder of a new run; or note the options of one that goes on, and remove what was in progress."""
        with _errors_of_writing(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            write_atomically(self.path / CONFIG_NAME, json.dumps(cfg.options(), indent=1))
        best = state.best.get("checkpoint")
        if best is not None and not (self.checkpoints / best).is_dir():  # somebody made room
            state.best = {}
        self.commit(state)
        self.clean(state)
        self._forget_metrics(state)

    def commit(self, state: RunState) -> None:
        """Make `state` the truth.

        Raises:
            InputError: It cannot be written. The state before is unharmed.
        """
        with _errors_of_writing(self.path):
            write_atomically(self.path / STATE_NAME, json.dumps(asdict(state), indent=1))

    def checkpoint(self, state: RunState) -> Path | None:
        """The folder of the newest weights, None before the first update.

        Raises:
            InputError: It is not there any more.
        """
        if state.checkpoint is None:
            return None
        folder = self.checkpoints / state.checkpoint
        if not folder.is_dir():
            raise InputError(f"{folder} is missing: the run cannot go on without its last checkpoint.")
        return folder

    def save_checkpoint(self, name: str, write: Callable[[Path], Any]) -> None:
        """Write a checkpoint as a whole: it is at its place and on the disk, or not there at all.

        Args:
            name: Of its folder.
            write: Writes the files into the folder it is given.

        Raises:
            InputError: It cannot be written; those before are unharmed.
        """
        folder = self.checkpoints / name
        with _errors_of_writing(self.path):
            if folder.exists():  # from a round that was not completed
                shutil.rmtree(folder)
            with new_folder(folder) as partial:
                write(partial)

    def clean(self, state: RunState) -> None:
        """Remove checkpoints that are neither the newest nor the best nor milestones; `last` and `best` name those."""
        if not self.checkpoints.is_dir():
            return
        named = {LAST_CHECKPOINT_LINK: state.checkpoint, BEST_LINK: state.best.get("checkpoint")}
        for name, checkpoint in named.items():
            if checkpoint is not None:
                replace_link(self.checkpoints / name, checkpoint)
            elif (self.checkpoints / name).is_symlink():
                (self.checkpoints / name).unlink()
        wanted = {*state.milestones, *named.values()}
        for name in [name for name in state.made if name not in wanted]:
            shutil.rmtree(self.checkpoints / name, ignore_errors=True)  # not where it is a link
            state.made.remove(name)

    def differences(self, cfg: DaggerConfig) -> list[str]:
        """What tells a run apart from the one in the folder: another task, other data, another expert or method."""
        saved = json.loads((self.path / CONFIG_NAME).read_text())
        options = json.loads(json.dumps(cfg.options()))
        names = [name for name in _SAME_RUN if saved.get(name) != options[name]]
        changed = [f"--{name} was {_brief(saved.get(name))} and is {_brief(options[name])}" for name in names]
        if (saved["num_episodes"] > 0) != cfg.is_online:  # one collects, and the other learns from what is there
            changed.append(f"--num_episodes was {saved['num_episodes']} and is {cfg.num_episodes}")
        return changed

    # Figures

    def append_metrics(self, line: dict[str, Any]) -> None:
        """Add a line to the figures. It holds only once a state that knows of it was committed."""
        with _errors_of_writing(self.path):
            append_line(self.path / METRICS_NAME, json.dumps(line))

    def metrics(self) -> list[dict[str, Any]]:
        """All lines of the figures; none before the first."""
        return read_metrics(self.path)

    def _forget_metrics(self, state: RunState) -> None:
        """Drop lines of what was in progress when the run was killed; it is done again."""
        path = self.path / METRICS_NAME
        if not path.is_file():
            return
        done = {"attempt": state.attempts, "round": state.round, "eval": state.evaluated_round}
        lines = ((line, line.get("attempt" if line.get("kind") == "attempt" else "round")) for line in self.metrics())
        kept = [
            json.dumps(line) + "\n"
            for line, number in lines
            if isinstance(number, int) and number <= done.get(str(line.get("kind")), -1)
        ]
        with _errors_of_writing(self.path):
            write_atomically(path, "".join(kept))


@contextlib.contextmanager
def _errors_of_writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"Cannot write to {folder}: {error}. What was saved before is complete; make room, and go on with "
            "--resume=true."
        ) from error


def _brief(value: Any) -> str:
    if not isinstance(value, dict):
        return str(value)
    return str({key: item for key, item in value.items() if key not in ("features", "features_map")})
