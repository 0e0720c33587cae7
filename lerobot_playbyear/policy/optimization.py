"""What training computes in, and how its learning rate runs."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.optim.schedulers import CosineDecayWithWarmupSchedulerConfig, LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

DTYPES = ("auto", "float32", "bfloat16", "float16")
"""What `--policy.dtype` can be."""

_NOTICEABLE = 1.1
"""How many times as large a learning rate has to be to be called a jump."""


def training_dtype(asked: str | None, use_amp: bool, device: str) -> str | None:
    """The number format that LeRobot's training computes in, by autocast; weights and the optimizer stay float32.

    Args:
        asked: One of `DTYPES`. None leaves it to `use_amp`.
        use_amp: As in LeRobot's policies: the 16-bit format that PyTorch takes on the device; on an NVIDIA GPU bfloat16
            where it has it.
        device: Where training takes place.

    Returns:
        "float32", "bfloat16" or "float16"; None where nothing was asked for, which leaves it to `accelerate launch`.
    """
    kind = torch.device(device).type
    if asked is None and use_amp:
        asked = "auto" if kind == "cuda" else str(torch.get_autocast_dtype(kind)).removeprefix("torch.")
    if asked == "auto" and kind == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float16"
    if asked == "auto":
        return "bfloat16" if kind == "cpu" and computes_bfloat16() else "float32"
    if asked is not None and not _computes(kind, asked):
        logging.warning(f"The device '{device}' cannot train in {asked}: --policy.dtype is float32 here.")
        return "float32"
    return asked


def computes_bfloat16() -> bool:
    """Whether this CPU multiplies in bfloat16 by itself; elsewhere autocast costs more time than it saves."""
    return _has_any("avx512_bf16", "amx_bf16")


def _has_any(*names: str) -> bool:
    capabilities: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in names)


HAS_512_BITS = _has_any("avx512_f")
"""Whether this CPU has AVX-512."""


def _computes(kind: str, dtype: str) -> bool:
    """Whether `accelerate` takes a format on a device; Apple's GPUs are left at float32, as LeRobot leaves them."""
    if dtype == "bfloat16":
        return kind in ("cpu", "xpu") or (kind == "cuda" and torch.cuda.is_bf16_supported())
    return dtype == "float32" or kind in ("cuda", "xpu")


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
            f"The learning rate rises from {before:.3g} to {after:.3g} at update {self.last_epoch}: the run was planned for "
            f"{n_decay} updates and now has {self.n_decay_steps}. A higher rate can undo what the policy has learned. To keep "
            f"the planned rate, and a low one after it, add "
            f"--scheduler.num_warmup_steps={n_warmup} --scheduler.num_decay_steps={n_decay} to the command."
        )
