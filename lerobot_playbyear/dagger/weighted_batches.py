"""Batches in which frames of attempts are learned from as often as a method wants, and not only what the expert chose.

Runs are drawn by the mean weight of their frames. That alone would smear weights over neighbours, so of every run's actions
some are masked by chance: each remains with a probability that makes up for how often its frame is drawn.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.dagger.batches import BalancedBatches, concatenated, draw, keep, of_actions
from lerobot_playbyear.dagger.methods.base import Learned
from lerobot_playbyear.datasets import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.training.windows import PolicyWindows

_IS_PAD = f"{ACTION}_is_pad"


class WeightedBatches(BalancedBatches):
    """Draws batches from demonstrations and attempts, as `BalancedBatches` does.

    Args:
        windows, demonstrations, interventions, batch_size, seed: As there.
        learned: Says of the attempts what is learned from how often.
    """

    def __init__(
        self,
        windows: PolicyWindows,
        demonstrations: EpisodeStore,
        interventions: EpisodeStore | None,
        batch_size: int,
        seed: int,
        learned: Callable[[EpisodeStore], Learned],
    ) -> None:
        self._learned, self._batch_size = learned, batch_size
        super().__init__(windows, demonstrations, interventions, batch_size, seed)

    def set_interventions(self, interventions: EpisodeStore) -> None:
        """Take in a store, or the episodes that were appended to it since the last time.

        Raises:
            InputError: None of its frames is to be learned from.
        """
        learned = self._learned(interventions)
        if not learned.weights.any():
            raise InputError(
                f"None of the {len(interventions)} frames of the intervention dataset has a weight above 0: there is nothing "
                "to learn from the attempts. Give other shares, --method.*, or collect attempts with --episodes."
            )
        weights = learned.weights.double()
        drawn = run_weights(interventions, self._windows.n_windows, weights)
        self._interventions, self._from_interventions = interventions, RunSampler(drawn, self._seed + 1)
        self._n_half = int(np.clip(round(learned.demonstrations * self._batch_size), 1, self._batch_size - 1))
        self._share = learned.demonstrations
        self._remains = _probabilities(interventions, weights, drawn, self._windows.action_deltas)

    def batch(self, number: int) -> dict[str, Any]:
        assert self._interventions is not None
        last = draw(self._from_interventions, number, self._batch_size - self._n_half)
        attempts = self._windows.batch(self._interventions, last)
        demonstrations = self._windows.batch(
            self._demonstrations, draw(self._from_demonstrations, number, self._n_half)
        )
        if len(self._windows.action_deltas) > 1:
            generator = self._generator(number)
            chance = of_actions(self._remains, last, self._windows) * (~attempts[_IS_PAD]).cpu()  # (B, K)
            remains = torch.rand(chance.shape, generator=generator, dtype=torch.float64) < chance
            remains |= (chance == chance.max()) & ~remains.any()  # something is learned in every batch
            is_learned = ~demonstrations[_IS_PAD]
            n_learned, n_remaining = int(is_learned.sum()), int(remains.sum())
            n_wanted = max(round(n_remaining * self._share / (1 - self._share)), 1)
            n_attempts = n_remaining if n_wanted <= n_learned else round(n_learned * (1 - self._share) / self._share)
            demonstrations[_IS_PAD] = ~keep(is_learned, min(n_wanted, n_learned), generator)
            attempts[_IS_PAD] = ~keep(remains.to(is_learned.device), max(n_attempts, 1), generator)
        common = [key for key in demonstrations if key in attempts]
        return {key: concatenated(demonstrations[key], attempts[key]) for key in common}


def _probabilities(store: EpisodeStore, weights: Tensor, drawn: Tensor, deltas: list[int]) -> Tensor:
    """With which probability an action of each frame remains, (N,), so that it is learned from as `weights` say.

    Args:
        store: The attempts.
        weights: (N,) how often each frame is to be learned from.
        drawn: (N,) how often the item that ends at, or of a chunk begins with, each frame is drawn.
        deltas: Where the actions of an item lie, in frames.
    """
    covered = torch.zeros_like(weights)
    for start, end in zip(store.starts, store.ends, strict=True):
        for delta in deltas:
            first, after = max(start, start + delta), min(end, end + delta)  # frames that an item here reaches
            if first < after:
                covered[first:after] += drawn[first - delta : after - delta]
    ratio = torch.where(covered > 0, weights / covered.clamp(min=1e-300), 0.0)
    return ratio / ratio.max() if ratio.any() else ratio
