"""What to draw from an `EpisodeStore`: runs of frames, some more often than others.

A training item is a run of K windows, named by its last frame: its windows end at that frame and at the K - 1 frames
before. Weights are given per frame ("this moment matters three times as much") and turned into weights of runs.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_playbyear.datasets.episode_store import EpisodeStore


class RunSampler:
    """Draws runs in proportion to their weights, spread over the whole store.

    A batch of B is drawn with one run in each B-th part of the total weight, so that it comes from as many episodes
    as there are. Every batch has a generator of its own, seeded with the seed and the number of batches before:
    resuming needs that number alone.

    Args:
        weights: (N,) the weight of the run that ends at each frame; at least one above 0.
        seed: Of the random numbers.
    """

    def __init__(self, weights: Tensor, seed: int = 0) -> None:
        self._seed = seed
        self._n_batches = 0
        self.set_weights(weights)

    def set_weights(self, weights: Tensor) -> None:
        """Replace the weights, for example after an episode was appended.

        Raises:
            ValueError: If a weight is negative or not finite, or all are 0.
        """
        weights = weights.to("cpu", torch.float64)
        if weights.ndim != 1 or not weights.isfinite().all() or (weights < 0).any() or weights.sum() <= 0:
            raise ValueError("Weights must be one finite number >= 0 per frame, and not all of them 0.")
        self._frames = weights.nonzero().squeeze(1)
        self._cumulative = weights[self._frames].cumsum(0)

    def draw(self, n: int) -> Tensor:
        """The last frames of the next batch of n runs, (n,) int64, in random order."""
        seed = int(np.random.SeedSequence([self._seed, self._n_batches]).generate_state(1, np.uint64)[0])
        generator = torch.Generator().manual_seed(seed)
        self._n_batches += 1
        within = torch.rand(n, generator=generator, dtype=torch.float64)
        shift = torch.rand(1, generator=generator, dtype=torch.float64)
        places = (torch.randperm(n, generator=generator) + within) / n + shift
        position = torch.searchsorted(self._cumulative, (places % 1.0) * self._cumulative[-1], right=True)
        return self._frames[position.clamp_(max=len(self._frames) - 1)]

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` needs to go on with the next batch; plain numbers."""
        return {"seed": self._seed, "n_batches": self._n_batches}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken; the weights have to be the same."""
        self._seed, self._n_batches = int(state["seed"]), int(state["n_batches"])


def run_weights(
    store: EpisodeStore, n_windows: int = 1, frame_weights: Tensor | None = None, n_dropped: int = 0
) -> Tensor:
    """How often to draw the run that ends at each frame, so that frames are learned from as often as they should.

    A run's weight is the mean weight of the frames that its windows end at. Runs that would reach before the episode
    are not drawn. Only one run holds the first frame, and only one the last, whereas K hold one in the middle: the
    first and the last run of an episode weigh (K + 1) / 2 times as much to make up for it.

    Args:
        store: The episodes.
        n_windows: K, the windows per run.
        frame_weights: (N,) how much each frame matters; None means all the same.
        n_dropped: How many of the last frames of every episode no run reaches; an episode no longer is not drawn at all.

    Returns:
        (N,) float64, 0 for frames at which no run ends.
    """
    frame_weights = torch.ones(len(store)) if frame_weights is None else frame_weights
    frame_weights = frame_weights.to("cpu", torch.float64)
    weights = torch.zeros(len(store), dtype=torch.float64)
    for start, whole_end in zip(store.starts, store.ends, strict=True):
        end = whole_end - n_dropped
        if end <= start:
            continue
        k = min(n_windows, end - start)
        means = frame_weights[start:end].unfold(0, k, 1).mean(dim=1)  # (L - K + 1,)
        weights[start + k - 1 : end] = means
        weights[start + k - 1] += (k - 1) / 2 * means[0]
        weights[end - 1] += (k - 1) / 2 * means[-1]
    return weights
