"""The checkpoints of a run: their names, and how a run goes on from one."""

from pathlib import Path
from typing import Any

from lerobot.optim import load_optimizer_state, load_scheduler_state
from lerobot.utils.constants import TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.io_utils import load_json
from lerobot.utils.random_utils import load_rng_state
from torch.optim import Optimizer

BEST_LINK = "best"


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
