"""Batches in which frames of attempts are learned from as often as a method wants, and not only what the expert chose.

Runs are drawn so that they lie, where that wastes least, among frames of one weight. Some hold others, too, so of every run's
actions some are masked by chance: each remains with a probability that makes up for how often its frame is drawn. A chunk is
drawn by the weight of the frame whose observation it answers, and of its actions those that weigh less remain by chance: there
it is the observations that are learned from as often as the method wants.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.dagger.batches import BalancedBatches, concatenated, draw, keep, of_actions, stretches
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
        n_windows, share, weights = self._windows.n_windows, learned.demonstrations, learned.weights.double()
        drawn = how_often_drawn(interventions, weights, n_windows)
        self._interventions, self._from_interventions = interventions, RunSampler(drawn, self._seed + 1)
        self._is_learned = weights > 0
        self._weights, self._remains, self._share = weights, chances(interventions, weights, drawn, n_windows), share
        masked = n_windows / learned_per_run(
            interventions, weights, drawn, n_windows
        )  # >= 1: so many more runs are needed
        n_demonstrations = self._batch_size * share / (share + (1 - share) * masked)
        self._n_half = int(np.clip(round(n_demonstrations), 1, self._batch_size - 1))

    def batch(self, number: int) -> dict[str, Any]:
        assert self._interventions is not None
        last = draw(self._from_interventions, number, self._batch_size - self._n_half)
        attempts = self._windows.batch(self._interventions, last)
        demonstrations = self._windows.batch(
            self._demonstrations, draw(self._from_demonstrations, number, self._n_half)
        )
        if len(self._windows.action_deltas) > 1:
            generator = self._generator(number)
            chance = self._chances_of(last) * (~attempts[_IS_PAD]).cpu()  # (B, K)
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

    @property
    def _n_actions(self) -> int:
        return max(len(self._windows.action_deltas), 1)

    def _learned_per_item(self, drawn: Tensor) -> float:
        """How many actions of an item of the attempts are learned from, on average."""
        assert self._interventions is not None
        if self._windows.n_windows > 1 or self._n_actions == 1:
            return learned_per_run(self._interventions, self._weights, drawn, self._windows.n_windows)
        frames = drawn.nonzero().squeeze(1)
        return float((self._chances_of(frames).sum(1) * drawn[frames]).sum() / drawn.sum())

    def _chances_of(self, last: Tensor) -> Tensor:
        """With which probability each action of the items at the frames `last` remains, (B, K)."""
        if self._windows.n_windows > 1:
            return of_actions(self._remains, last, self._windows)
        return (of_actions(self._weights, last, self._windows) / self._weights[last].unsqueeze(1)).clamp(max=1)


def how_often_drawn(store: EpisodeStore, weights: Tensor, n_windows: int) -> Tensor:
    """How often to draw the run that ends at each frame, (N,) float64.

    Of two ways the one of which more actions are learned: runs side by side in every stretch of frames of one weight, which
    is best where kinds of frames differ, and runs everywhere by their frames' mean weight, where weights change all the time.

    Args:
        store: The attempts.
        weights: (N,) float64, how often each frame is to be learned from.
        n_windows: K, the windows per run.
    """
    candidates = (_by_stretches(store, weights, n_windows), run_weights(store, n_windows, weights))
    return max(candidates, key=lambda drawn: learned_per_run(store, weights, drawn, n_windows))


def learned_per_run(store: EpisodeStore, weights: Tensor, drawn: Tensor, n_windows: int) -> float:
    """How many of a run's K actions are learned from, on average, when runs are drawn so and masked as `chances` says."""
    return float((chances(store, weights, drawn, n_windows) * _covered(store, drawn, n_windows)).sum() / drawn.sum())


def chances(store: EpisodeStore, weights: Tensor, drawn: Tensor, n_windows: int) -> Tensor:
    """With which probability an action of each frame remains, (N,), so that it is learned from as `weights` say.

    Args:
        store: The attempts.
        weights: (N,) how often each frame is to be learned from.
        drawn: (N,) how often the run that ends at each frame is drawn.
        n_windows: K, the windows per run.
    """
    covered = _covered(store, drawn, n_windows)
    ratio = torch.where(covered > 0, weights / covered.clamp(min=1e-300), 0.0)
    return ratio / ratio.max() if ratio.any() else ratio


def _by_stretches(store: EpisodeStore, weights: Tensor, n_windows: int) -> Tensor:
    drawn = np.zeros(len(store))
    for start, end in zip(store.starts, store.ends, strict=True):
        here = weights[start:end].numpy()
        for value in np.unique(here[here > 0]):
            for first, after in stretches(here == value) + start:
                n_runs = -(-(after - first) // n_windows)
                ends = np.linspace(first + n_windows, max(after, first + n_windows), n_runs).round().astype(int)
                np.add.at(drawn, ends.clip(max=end) - 1, value)
    return torch.from_numpy(drawn)


def _covered(store: EpisodeStore, drawn: Tensor, n_windows: int) -> Tensor:
    """How often each frame lies in a run that is drawn, (N,)."""
    covered = torch.zeros_like(drawn)
    for start, end in zip(store.starts, store.ends, strict=True):
        for delta in range(min(n_windows, end - start)):
            covered[start : end - delta] += drawn[start + delta : end]
    return covered
