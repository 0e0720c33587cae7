"""What several test modules read and none changes: made once for all processes that run tests."""

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


def run_in_process(main: Callable[[], Any], *arguments: str | Path) -> Any:
    """Run a command in this process. Returns what `main` returns, or the exit status or message that it ended with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["command", *map(str, arguments)])
        try:
            return main()
        except SystemExit as end:
            return end.code


def once(folder: Path, name: str, make: Callable[[Path], Any]) -> Path:
    """The folder `name` in `folder`, made by the first process that asks for it."""
    place, made = folder / name, folder / f"{name}.made"
    with FileLock(folder / f"{name}.lock"):
        if not made.exists():
            make(place)
            made.touch()
    return place
