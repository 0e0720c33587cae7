"""The schedule of the learning rate, which says so when a run is to go on for longer than it was planned for."""

import logging
from dataclasses import dataclass
from typing import Any

from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig, LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

_NOTICEABLE = 1.1
"""How many times as large a rate has to be to be called a jump."""


@LRSchedulerConfig.register_subclass("playbyear")
@dataclass
class PlaybyearSchedulerConfig(CosineDecayWithWarmupSchedulerConfig):
    """LeRobot's linear warm-up and cosine, shrunk together to the run's length; resuming it with a larger one is noticed."""

    def build(self, optimizer: Optimizer, num_training_steps: int) -> "PlannedLR":
        """The schedule of a run of `num_training_steps` updates."""
        share = min(1.0, num_training_steps / self.num_decay_steps)
        n_warmup, n_decay = int(self.num_warmup_steps * share), min(num_training_steps, self.num_decay_steps)
        return PlannedLR(optimizer, super().build(optimizer, num_training_steps).lr_lambdas[0], n_warmup, n_decay)


class PlannedLR(LambdaLR):
    """A schedule that knows how long it is, and compares when it takes up a checkpoint's.

    Args:
        optimizer: Whose rate it sets.
        lr_lambda: Updates done -> share of the largest rate.
        n_warmup_steps: Updates over which the rate rises.
        n_decay_steps: Updates after which it has fallen.
    """

    def __init__(self, optimizer: Optimizer, lr_lambda: Any, n_warmup_steps: int, n_decay_steps: int) -> None:
        self.n_warmup_steps, self.n_decay_steps = n_warmup_steps, n_decay_steps
        super().__init__(optimizer, lr_lambda)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where the checkpoint is, by the own plan and not the checkpoint's."""
        own = {"n_warmup_steps": self.n_warmup_steps, "n_decay_steps": self.n_decay_steps}
        super().load_state_dict({**state_dict, **own})
        before, after = state_dict["_last_lr"][0], self.base_lrs[0] * self.lr_lambdas[0](self.last_epoch)
        if after <= _NOTICEABLE * before:
            return
        n_warmup, n_decay = state_dict["n_warmup_steps"], state_dict["n_decay_steps"]
        logging.warning(
            f"The learning rate rises from {before:.3g} to {after:.3g}: the run was planned for {n_decay} updates and is at "
            f"{self.last_epoch}; planned for {self.n_decay_steps}, the rate falls anew until then. That unsettles a policy "
            f"that had settled. To keep the rate as it was planned, and low after that, add "
            f"--scheduler.num_warmup_steps={n_warmup} --scheduler.num_decay_steps={n_decay} to the command."
        )
