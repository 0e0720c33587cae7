"""What several test modules read and none changes: made once for all processes that run tests."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

ENV = ("--env.type=playbyear", "--env.task=OccludedGrasp-v1", "--env.image_size=16")
"""The environment of `recorded` and `trained`."""

TINY = (
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=16",
    "--policy.vision_width=4",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=2",
    "--policy.n_supervised_steps=4",
    "--policy.hidden_size=32",
    "--num_workers=0",
    "--batch_size=2",
)
"""The smallest policy that learns from them, and a training that takes a second."""


FOLDER = Path()
"""What all processes of this run of the tests share; `conftest.py` says where it is."""


def run_in_process(main: Callable[[], Any], *arguments: str | Path) -> Any:
    """Run a command in this process. Returns what `main` returns, or the exit status or message that it ended with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["command", *map(str, arguments)])
        if state := sys.modules.get("accelerate.state"):  # what a process computes in is decided once in it
            state.AcceleratorState._reset_state()
        try:
            return main()
        except SystemExit as end:
            return end.code
        finally:
            if state := sys.modules.get("accelerate.state"):
                state.AcceleratorState._reset_state()


def n_evaluated(checkpoint: Path, folder: Path, *options: str) -> int:
    """How many episodes `lerobot-eval` has played when it ends: one."""
    from lerobot.scripts import lerobot_eval

    given = (f"--policy.path={checkpoint}", "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={folder}")
    run_in_process(lerobot_eval.main, *given, *options)
    return json.loads((folder / "eval_info.json").read_text())["overall"]["n_episodes"]


def once(name: str, make: Callable[[Path], Any]) -> Path:
    """The folder of this name, made by the first process that asks for it."""
    place, made = FOLDER / name, FOLDER / f"{name}.made"
    with FileLock(FOLDER / f"{name}.lock"):
        if not made.exists():
            make(place)
            made.touch()
    return place


def recorded() -> Path:
    """A dataset of two episodes of the expert in `ENV`. Copy it to change it."""
    from lerobot_playbyear.scripts.commands import record

    data = ("--dataset.repo_id=tests/demos", "--dataset.num_episodes=2", "--num_workers=0")
    return once("demos", lambda root: _succeeds(record, *ENV, *data, f"--dataset.root={root}"))


def trained() -> Path:
    """A checkpoint, `pretrained_model`, of the policy `TINY` after two updates on `recorded`: it does nothing well."""
    from lerobot_playbyear.scripts.commands import train

    data = ("--dataset.repo_id=tests/demos", f"--dataset.root={recorded()}", "--steps=2")
    run = once("trained", lambda folder: _succeeds(train, *TINY, *data, f"--output_dir={folder}"))
    return run / "checkpoints/000002/pretrained_model"


def _succeeds(main: Callable[[], Any], *arguments: str) -> None:
    assert run_in_process(main, *arguments) is None
