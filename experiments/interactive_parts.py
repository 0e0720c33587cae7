"""The parts of a study of corrections that several studies share, or that go on after one was killed: each is made once.

A study that comes second to a folder waits: for another study, for a command that outlived the study that began it, and for
one that something else began, as `experiments.ablations` that trains the same policy.
"""

import contextlib
import fcntl
import json
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from experiments.protocol import N_DEMONSTRATIONS, RUNS, dataset_root, load, record, save, shown
from experiments.training import Job, clocked, train
from lerobot_playbyear.training.command_line import preset_options

PAUSE_S = 10.0
_OF_NO_WEIGHT = ("policy.path", "policy.device", "policy.push_to_hub")  # a policy is the same with another


def first_job(task: str, seed: int, n: int, options: Sequence[str] = (), threads: int = 1) -> Job:
    """The training of a first policy. With the usual demonstrations and no options it is that of `experiments.ablations`.

    Args:
        task, seed: What is learned, and the training's seed.
        n: Demonstrations.
        options: `--policy.NAME=VALUE` of `playbyear-train`; they are part of the training's name.
        threads: For every command.
    """
    options = sorted(set(options))
    variant = "-".join(re.sub(r"[^\w.-]", "_", option.removeprefix("--policy.")) for option in options)
    dataset = None if n == N_DEMONSTRATIONS else _root(task, n)
    return Job(
        "ablations", task, "full", seed, n, threads=threads, options=tuple(options), variant=variant, dataset=dataset
    )


def trained(job: Job) -> str:
    """Trains a policy, unless somebody has.

    Returns:
        The command, as a person would type it.

    Raises:
        RuntimeError: What lies there under the training's name was trained with other options.
    """
    folder = RUNS / "train" / job.name
    with alone(folder):
        _check_options(job, folder)
        return train(job)[0]


def demonstrated(task: str, n: int) -> tuple[Path, int]:
    """Records the first n demonstrations of a task, or what is missing of them.

    Returns:
        The dataset, which holds no more, because `playbyear-dagger` learns from all that it is given; and its frames.
    """
    root = _root(task, n)
    if _totals(root)["total_episodes"] > n:  # another study needed more
        root = RUNS / "datasets" / f"{task}-{n}"
    with alone(root):
        if _totals(root)["total_episodes"] < n:
            record(task, n, root)
    return root, _totals(root)["total_frames"]


def finished(command: list[str], folder: Path, threads: int) -> str:
    """Runs a command that can go on where it stopped, to its end, and once.

    Finished ones are noted in a file beside the folder: `playbyear-dagger` would take attempts that a later command kept in
    the same dataset for its own.

    Args:
        command: What is to run.
        folder: What it writes to.
        threads: For the command.

    Returns:
        The command, as a person would type it.
    """
    mark, text = folder.with_name(f"{folder.name}.done.json"), shown(command)
    with alone(folder):
        done = load(mark) if mark.exists() else []
        if text not in done:
            if folder.exists() and not (folder / "dagger_config.json").exists():  # killed before it began
                shutil.rmtree(folder)
            clocked(command, folder, threads)
            save(mark, [*done, text])
    return text


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Waits until nobody else works at a file or folder. The lock beside it ends with the process, however that ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f"{path.name}.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"Waiting for another study at {path}", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        if is_written_to(path):
            print(f"Waiting for a command that writes to {path}", flush=True)
        while is_written_to(path):
            time.sleep(PAUSE_S)
        yield


def is_written_to(folder: Path) -> bool:
    """Whether a training, a recording or corrections are at work in a folder; known on Linux alone."""
    wanted = folder.resolve()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            arguments = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
            at = (process / "cwd").readlink()
            records = any(Path(argument).name == "playbyear-record" for argument in arguments[:2])
            names = ("--output_dir", "--config_path", *(["--dataset.root"] if records else []))
            given = (argument.partition("=") for argument in arguments)
            paths = ((at / value).resolve() for name, _, value in given if name in names)
            if any(wanted in (path, *path.parents) for path in paths):
                return True
    return False


def newest(folder: Path) -> Path:
    """The last checkpoint of a run."""
    return folder / "checkpoints" / "last" / "pretrained_model"


def metrics_of(folders: Iterable[Path]) -> Iterable[dict[str, Any]]:
    """The lines of some runs' attempts."""
    for folder in folders:
        yield from (json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines())


def _root(task: str, n: int) -> Path:
    return dataset_root(task) if n == N_DEMONSTRATIONS else RUNS / "datasets" / f"{task}-{n}"


def _totals(root: Path) -> dict[str, Any]:
    info = root / "meta" / "info.json"
    return load(info) if info.exists() else {"total_episodes": 0}


def _check_options(job: Job, folder: Path) -> None:
    """A training's name does not tell what its preset held when it began; its checkpoint does."""
    path = folder / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    if not path.exists():
        return
    given = dict(option.removeprefix("--").split("=", 1) for option in (*job.start, *job.options))
    asked = {**(preset_options(given["preset"]) if "preset" in given else {}), **given}
    saved = load(path)
    saved |= {f"policy.{key}": value for key, value in saved["policy"].items()}
    differences = [
        f"{key} was {saved.get(key)} and is {value}"
        for key, value in asked.items()
        if (key.startswith("policy.") or key == "batch_size")
        and key not in _OF_NO_WEIGHT
        and not _is_same(saved.get(key), value)
    ]
    if differences:
        raise RuntimeError(
            f"{folder} holds a policy of other options: {'; '.join(differences)}. Move it away to train another."
        )


def _is_same(saved: Any, option: str) -> bool:
    """Whether a value is the one that an option gives."""
    with contextlib.suppress(json.JSONDecodeError):
        return bool(saved == json.loads(option))
    return str(saved) == option
