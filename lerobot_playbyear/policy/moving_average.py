"""An exponential moving average of a network's weights, which acts in its place."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

_LEARNS, _AVERAGED = "model.", "averaged."  # of names in a policy's checkpoint


class MovingAverage(AveragedModel):
    """torch's `AveragedModel` with a decay that rises to its final value; buffers, such as batch norm's, are averaged too.

    Args:
        network: What is averaged. Its parameters are copied, and need no gradient here.
        decay: Weight of the past, below 1.
    """

    def __init__(self, network: nn.Module, decay: float):
        super().__init__(network, multi_avg_fn=_rising_average(decay), use_buffers=True)
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> "MovingAverage":
        """Stays as it acts: no augmentation, running statistics."""
        return super().train(False)


def without_average(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Of a policy's checkpoint, the weights that the last update left."""
    return {name: tensor for name, tensor in weights.items() if not name.startswith(_AVERAGED)}


def with_average(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """A policy's checkpoint with an average, which begins with its first update if there was none."""
    if any(name.startswith(_AVERAGED) for name in weights):
        return weights
    begun = {name.replace(_LEARNS, f"{_AVERAGED}module.", 1): tensor.clone() for name, tensor in weights.items()}
    return {**weights, **begun, f"{_AVERAGED}n_averaged": torch.tensor(0)}


def _rising_average(decay: float) -> Callable[..., None]:
    def average(averaged: Sequence[Tensor], current: Sequence[Tensor], n_averaged: Any) -> None:
        n = int(n_averaged)
        get_ema_multi_avg_fn(min(decay, (1 + n) / (10 + n)))(averaged, current, n_averaged)

    return average
