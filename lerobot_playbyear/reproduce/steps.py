"""A step of a cell: one command, run in a fork of this process, once, and again from where it was when it did not end well.

Beside a step's folder stand its lock, its log, what its attempts took (`.begun.json`) and, when it is done, `.done.json`.
"""

import contextlib
import ctypes
import importlib
import json
import os
import runpy
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

from filelock import FileLock

from lerobot_playbyear.datasets.errors import InputError, PlaybyearError
from lerobot_playbyear.datasets.files import parse_json, replace_link, write_atomically
from lerobot_playbyear.datasets.journal import JOURNAL, finish_journal, lock_dataset
from lerobot_playbyear.reproduce.plan import Step

_IMPORTED = (
    "lerobot.scripts.lerobot_eval",
    "lerobot_playbyear.recording.record",
    "lerobot_playbyear.training.train",
    "lerobot_playbyear.dagger.run",
    "lerobot_playbyear.film.rollout_film",
)
"""By the commands: with these a fork of this process starts in a second instead of fifteen."""

_WITHOUT_WEIGHT = ("--policy.device=", "--policy.push_to_hub=")  # options: what is made is the same with others
_LAST_LINES = 15  # of a log, in an error
_PR_SET_PDEATHSIG = 1


class StepError(PlaybyearError, RuntimeError):
    """A command did not end well."""


def prepare() -> None:
    """Imports LeRobot and what learns, once for all forks."""
    for module in _IMPORTED:
        importlib.import_module(module)
    from lerobot.envs import EnvConfig
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    with contextlib.suppress(KeyError, ImportError):
        EnvConfig.get_choice_class("playbyear")()  # imports MuJoCo and the tasks


def carry_out(step: Step, threads: int = 1) -> float:
    """Runs a step's command, unless that was done; waits for another process that is at it.

    Args:
        step: The step.
        threads: Of the command.

    Returns:
        The minutes that it took in all, those of attempts that were killed included.

    Raises:
        InputError: Its folder was made by another command.
        StepError: The command failed; the message ends with its last lines.
    """
    step.folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(_beside(step, "lock"), poll_interval=0.5):
        done, begun, log = (_beside(step, ending) for ending in ("done.json", "begun.json", "log"))
        if done.is_file():
            noted = parse_json(done.read_bytes())
            if _telling(noted["command"]) != _telling(step.shown):
                raise InputError(
                    f"{step.folder} was made by another command than the plan's:\n  {noted['command']}\n  {step.shown}\n"
                    f"Remove it and {done}, or choose another --output_dir."
                )
            return float(noted["minutes"])
        spent = _minutes_before(begun, log)
        command = resumed(step)
        write_atomically(begun, json.dumps({"minutes": spent, "at": time.time()}))
        start = time.monotonic()
        status = in_a_fork(command, log, threads) if command else 0
        spent += (time.monotonic() - start) / 60
        if status:
            write_atomically(begun, json.dumps({"minutes": spent}))
            lines = log.read_text(errors="replace").replace("\r", "\n").splitlines()[-_LAST_LINES:]
            raise StepError(f"{step.shown}\nended with {status}; {log} ends with\n" + "\n".join(lines))
        write_atomically(done, json.dumps({"command": step.shown, "minutes": round(spent, 3)}, indent=1))
        return spent


def resumed(step: Step) -> list[str]:
    """The command that goes on where the step's last attempt stopped; empty if nothing is missing."""
    command, folder = list(step.command), step.folder
    given = dict(word.removeprefix("--").split("=", 1) for word in command if "=" in word)
    if command[0] == "playbyear-record":
        if os.path.lexists(folder / JOURNAL):
            with lock_dataset(folder):
                finish_journal(folder)  # an episode that was killed while it was moved into place counts
        info = folder / "meta" / "info.json"
        there = parse_json(info.read_bytes())["total_episodes"] if info.is_file() else 0
        name = "--dataset.num_episodes="
        missing = int(given[name.strip("-=")]) - there
        return [f"{name}{missing}" if word.startswith(name) else word for word in command] if missing > 0 else []
    if command[0] == "playbyear-train":
        last = folder / "checkpoints" / "last"
        options = last / "pretrained_model" / "train_config.json"
        complete = sorted(last.parent.glob("[0-9]*/training_state/optimizer_param_groups.json"))
        if complete and not options.is_file():  # it was killed before it had linked the newest
            replace_link(last, complete[-1].parents[1].name)
        if options.is_file():
            step_ = parse_json((last / "training_state" / "training_step.json").read_bytes())["step"]
            return [] if step_ >= int(given["steps"]) else [command[0], "--resume=true", f"--config_path={options}"]
    begun = command[0] == "playbyear-dagger" and (folder / "dagger_config.json").is_file()
    if command[0] in ("playbyear-train", "lerobot-eval") or (command[0] == "playbyear-dagger" and not begun):
        shutil.rmtree(folder, ignore_errors=True)  # what was killed before there was anything to go on with
    return command


def in_a_fork(command: list[str], log: Path, threads: int) -> int:
    """Runs a command as if it were typed, in a fork of this process that ends with this process.

    Returns:
        Its exit status, negative if a signal ended it.
    """
    pid = forked(lambda: _become(command, log, threads))
    try:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    except BaseException:
        os.kill(pid, signal.SIGTERM)
        raise


def forked(work: Callable[[], int]) -> int:
    """Starts a copy of this process that does some work and ends with its status; on Linux also when this process ends.

    Elsewhere it may outlive this process, whose locks it does not keep: wait for it before the same is begun again.

    Returns:
        The copy's number.
    """
    parent = os.getpid()
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings(action="ignore"):  # of the threads that libraries keep: none of them is at work yet
        pid = os.fork()
    if pid == 0:
        status = 1
        try:
            if sys.platform == "linux":
                ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
                if os.getppid() != parent:  # it ended before it could be asked for
                    os._exit(status)
            status = work()
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):  # a full disk, or a pipe that nobody reads
                with contextlib.suppress(BaseException):
                    stream.flush()
            os._exit(status)
    return pid


def _become(command: list[str], log: Path, threads: int) -> int:
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    os.environ["OMP_NUM_THREADS"] = str(threads)
    try:
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(threads)
        print(f"$ {' '.join(command)}", flush=True)
        _call(command)
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _call(command: list[str]) -> None:
    if command[:2] == ["python", "-m"]:
        sys.argv = command[2:]
        runpy.run_module(command[2], run_name="__main__", alter_sys=True)
    elif command[0] == "python":
        sys.argv = command[1:]
        sys.path.insert(0, os.path.dirname(os.path.abspath(command[1])))  # as Python does for a program
        runpy.run_path(command[1], run_name="__main__")
    else:
        sys.argv = command
        next(iter(metadata.entry_points(group="console_scripts", name=command[0]))).load()()


def _beside(step: Step, ending: str) -> Path:
    # Films share a folder.
    name = step.command[-1].rpartition("/")[2].partition(".")[0] if step.name == "film" else ""
    return step.folder.with_name(".".join(filter(None, [step.folder.name, name, ending])))


def _minutes_before(begun: Path, log: Path) -> float:
    """What earlier attempts took; one that was killed, until its last line."""
    if not begun.is_file():
        return 0.0
    told = parse_json(begun.read_bytes())
    last = max(0.0, log.stat().st_mtime - told["at"]) / 60 if "at" in told and log.exists() else 0.0
    return float(told["minutes"]) + last


def _telling(command: str) -> list[str]:
    return [word for word in command.split() if not word.startswith(_WITHOUT_WEIGHT)]
