"""What lies in the output folder of a training: checkpoints, their options, and the figures."""

import json
from pathlib import Path
from typing import Any

from huggingface_hub.constants import CONFIG_NAME, SAFETENSORS_SINGLE_FILE
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR

from lerobot_playbyear.hub.pushing import HubError

METRICS_NAME = "metrics.jsonl"
"""File in the output folder with one JSON object per line."""


def find_checkpoint(path: Path) -> Path:
    """The folder `pretrained_model` in or at `path`.

    Raises:
        HubError: There is none.
    """
    for inside in ("", PRETRAINED_MODEL_DIR, f"{CHECKPOINTS_DIR}/{LAST_CHECKPOINT_LINK}/{PRETRAINED_MODEL_DIR}"):
        folder = path / inside
        if all((folder / name).is_file() for name in (CONFIG_NAME, SAFETENSORS_SINGLE_FILE)):
            return folder
    raise HubError(
        f"policy.path={path}: there is no checkpoint with {CONFIG_NAME} and {SAFETENSORS_SINGLE_FILE}. Give the folder "
        f"`{PRETRAINED_MODEL_DIR}` of one, or the output folder of a training."
    )


def evaluation_of(checkpoint: Path) -> dict[str, float] | None:
    """The figures of the last evaluation in the simulator, if it was of this checkpoint.

    Args:
        checkpoint: A folder `<run>/checkpoints/<step>/pretrained_model`.
    """
    folder = checkpoint.resolve()
    state, metrics = folder.parent / "training_state" / "training_step.json", folder.parent.parent.parent / METRICS_NAME
    if not (state.is_file() and metrics.is_file()):
        return None
    step = json.loads(state.read_text())["step"]
    lines = [figures_in(line) for line in metrics.read_text().splitlines()]
    found = [line for line in lines if line.get("kind") == "eval" and line.get("step") == step and "pc_success" in line]
    return found[-1] if found else None


def figures_in(line: str) -> dict[str, Any]:
    """What a line says; nothing if a run that was killed, or a full disk, cut it off."""
    try:
        figures = json.loads(line)
    except ValueError:
        return {}
    return figures if isinstance(figures, dict) else {}
