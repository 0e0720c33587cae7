"""The command that trains on a dataset, as every message and card that names it has it."""

import shlex
from collections.abc import Iterable
from pathlib import Path

from lerobot_playbyear.datasets.features import audio_keys

_PICTURES = "observation.image"  # what the keys of cameras start with


def training_command(
    repo_id: str, features: Iterable[str], root: str | Path | None = None, preset: str | None = None
) -> str:
    """What to type to train a policy on a dataset, within the hour; it works as it stands.

    Args:
        repo_id: The dataset's name.
        features: The names of its features; the policy does without what is not among them.
        root: Its folder. None: LeRobot finds it by its name.
        preset: The preset. None: the one for this machine.
    """
    if preset is None:
        import torch  # here, because commands that work on files alone do without it

        preset = "gpu" if torch.cuda.is_available() else "cpu"
    names = list(features)
    options = {
        "preset": preset,
        "dataset.repo_id": repo_id,
        "dataset.root": root,
        "output_dir": f"outputs/train/{repo_id.rpartition('/')[2]}",
        "policy.use_vision": None if any(name.startswith(_PICTURES) for name in names) else "false",
        "policy.use_audio": None if audio_keys(names) else "false",
    }
    given = (f"--{name}={value}" for name, value in options.items() if value is not None)
    return " ".join(["playbyear-train", *map(shlex.quote, given)])
