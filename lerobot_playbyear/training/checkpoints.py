"""The checkpoints of a run: which acts, the one with the lowest held-out loss or an average; how a run goes on from one."""

import math
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.optim import load_optimizer_state, load_scheduler_state
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR, TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.io_utils import load_json
from lerobot.utils.random_utils import load_rng_state
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.optim import Optimizer

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.hub.training_run import METRICS_NAME, figures_in

BEST_LINK = "best"


class BestCheckpoint:
    """Keeps the link `checkpoints/best` at the checkpoint of a run whose held-out loss is the lowest.

    Args:
        output_dir: Of the run. What its figures say of checkpoints that are there counts, so that a resumed run goes on.
        step: Updates done; what a longer run had reached beyond them does not count.

    Attributes:
        loss: Of the best one; infinite before there is any.
        step: Its updates; None before.
    """

    def __init__(self, output_dir: Path, step: int = 0) -> None:
        self.loss = math.inf
        self.step: int | None = None
        folder, figures = output_dir / CHECKPOINTS_DIR, output_dir / METRICS_NAME
        if not (folder.is_dir() and figures.is_file()):
            return
        saved = {int(path.name): path for path in folder.iterdir() if path.name.isdigit()}
        lines = [figures_in(line) for line in figures.read_text().splitlines()]
        losses = {line["step"]: line["loss"] for line in lines if line.get("kind") == "validation"}
        for each in sorted(set(saved) & set(losses)):
            if each <= step:
                self.offer(saved[each], losses[each])

    def offer(self, checkpoint: Path, loss: float) -> None:
        """One more checkpoint, `<run>/checkpoints/<step>`, with its held-out loss; of equal ones the first is the best."""
        if not loss < self.loss:  # nor if it is not a number
            return
        self.loss, self.step = loss, int(checkpoint.name)
        new = checkpoint.with_name(f".{BEST_LINK}.new")
        new.unlink(missing_ok=True)
        new.symlink_to(checkpoint.name)
        os.replace(new, checkpoint.with_name(BEST_LINK))


def load_training_state(checkpoint: Path, optimizer: Optimizer, scheduler: Any) -> int:
    """Reads what LeRobot wrote beside the policy, before the optimizer is prepared: random numbers, optimizer, schedule.

    LeRobot's own function for this is another one in every version; the parts that it calls stay.

    Args:
        checkpoint: `<run>/checkpoints/<step>`.
        optimizer: Gets its state.
        scheduler: Gets its state; None: there is none.

    Returns:
        Updates done.

    Raises:
        NotADirectoryError: The checkpoint has no training state.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    if not folder.is_dir():
        raise NotADirectoryError(folder)
    load_rng_state(folder)
    load_optimizer_state(optimizer, folder)
    if scheduler is not None:
        load_scheduler_state(scheduler, folder)
    return int(load_json(folder / TRAINING_STEP)["step"])


def last_checkpoints(output_dir: Path, n: int) -> list[Path]:
    """The folders `pretrained_model` of a run's last n checkpoints, the newest last.

    Raises:
        InputError: There are fewer.
    """
    folder = output_dir / CHECKPOINTS_DIR
    saved = sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda path: int(path.name))
    if len(saved) < n:
        raise InputError(
            f"{folder} holds {len(saved)} checkpoints, wanted the last {n}: train with a smaller --save_freq, or take fewer."
        )
    return [path / PRETRAINED_MODEL_DIR for path in saved[len(saved) - n :]]


def average_checkpoints(checkpoints: Sequence[Path], output: Path) -> Path:
    """Makes one policy of several checkpoints of a run: the mean of their weights and of their running statistics.

    Whole numbers, such as counts of batches, and all other files are those of the last checkpoint given.

    Args:
        checkpoints: Folders `pretrained_model`.
        output: The new folder of the same kind, which must not be there yet.

    Returns:
        `output`.

    Raises:
        InputError: There is nothing to average, or the policies are not alike.
    """
    if not checkpoints:
        raise InputError("No checkpoint was given: an average needs at least one.")
    if output.exists():
        raise InputError(f"{output} is there already: give another folder, or move it away.")
    sums: dict[str, Tensor] = {}
    for folder in checkpoints:
        weights = load_file(folder / SAFETENSORS_SINGLE_FILE)
        if sums and {k: v.shape for k, v in sums.items()} != {k: v.shape for k, v in weights.items()}:
            raise InputError(
                f"{folder} holds another network than {checkpoints[0]}: average checkpoints of one run, or of runs with the "
                "same --policy options."
            )
        for name, value in weights.items():
            if value.is_floating_point():
                sums[name] = value.double() if name not in sums else sums[name] + value.double()
            else:
                sums[name] = value
    mean = {
        name: (sums[name] / len(checkpoints)).to(value.dtype) if value.is_floating_point() else value
        for name, value in weights.items()  # the last one's
    }
    unfinished = output.with_name(f"{output.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    shutil.copytree(checkpoints[-1], unfinished, ignore=shutil.ignore_patterns(SAFETENSORS_SINGLE_FILE))
    save_file(mean, unfinished / SAFETENSORS_SINGLE_FILE, metadata={"format": "pt"})
    unfinished.rename(output)
    return output
