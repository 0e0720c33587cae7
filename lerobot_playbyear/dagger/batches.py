"""Batches for the rounds: half demonstrations and half of what an expert chose, or both together, frame by frame.

A training item holds the actions of K windows that share encodings (`RunSampler`). An expert's stretch of control rarely begins
or ends where an item does, so actions are masked one by one, by LeRobot's `action_is_pad`: as many actions of demonstrations
are learned from as there are actions that the expert chose, and all weigh the same.
"""

import logging

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.parquet import stretches
from lerobot_playbyear.episodes.frames import INTERVENTION
from lerobot_playbyear.training.batches import Batch, PolicyWindows, RunSampler, run_weights
from lerobot_playbyear.training.store import EpisodeStore

_IS_PAD = f"{ACTION}_is_pad"


class BalancedBatches:
    """Draws batches of which one half are demonstrations, and the other what the expert chose.

    Each batch has random numbers of its own, seeded with the seed and its number: resuming needs that number alone.

    Args:
        windows: Cuts the policy's windows.
        demonstrations: All of whose frames are learned from.
        attempts: Whole attempts, with the column `intervention`. None while there are none.
        batch_size: Runs per batch, even.
        seed: Of the random numbers.
        n_skipped: Frames at the beginning of every correction that are not learned from, see `frames_learned_from`.

    Raises:
        InputError: Nothing of `attempts` can be learned from.
    """

    def __init__(
        self,
        windows: PolicyWindows,
        demonstrations: EpisodeStore,
        attempts: EpisodeStore | None,
        batch_size: int,
        seed: int = 0,
        n_skipped: int = 0,
    ) -> None:
        self._windows, self._batch_size, self._seed, self._n_skipped = windows, batch_size, seed, n_skipped
        self._demonstrations, self._attempts = demonstrations, attempts
        self._from_demonstrations = RunSampler(run_weights(demonstrations, windows.n_windows), seed)
        if attempts is not None:
            self.take_in(attempts)

    def take_in(self, attempts: EpisodeStore) -> None:
        """Take in a store of attempts, or the episodes that were appended to it since the last time.

        Raises:
            InputError: Nothing of it can be learned from.
        """
        self._learned = self.is_learned(attempts)
        weights = intervention_run_weights(attempts, self._windows.n_windows, self._learned)
        if not weights.any():
            raise InputError(
                f"None of the {len(attempts)} frames of the intervention dataset has '{INTERVENTION}' set: there is "
                "nothing to learn from an expert. Give a dataset of corrections, or collect some with --num_episodes."
            )
        self._attempts, self._from_attempts = attempts, RunSampler(weights, self._seed + 1)

    def batch(self, number: int) -> Batch:
        """The batch of that number, counted from 0, as `PolicyWindows.batch` gives it.

        `action_is_pad` (B, K) is also true where an action is not to be learned.
        """
        return joined(*self.halves(number))

    def halves(self, number: int) -> tuple[Batch, Batch]:
        """A batch of demonstrations and one of attempts, which also tells their losses apart."""
        assert self._attempts is not None
        n_half = self._batch_size // 2
        last = self._from_attempts.draw(n_half, number)
        corrections = self._windows.batch(self._attempts, last)
        shown = self._windows.batch(self._demonstrations, self._from_demonstrations.draw(n_half, number))
        is_shown = ~shown[_IS_PAD]  # (B/2, K)
        frames = (last.unsqueeze(1) + torch.tensor(self._windows.action_deltas)).clamp(min=0)  # (B/2, K)
        by_expert = self._learned[frames].to(is_shown.device) & ~corrections[_IS_PAD]
        seed = np.random.SeedSequence([self._seed + 2, number]).generate_state(1, np.uint64)[0]
        n, generator = int(min(is_shown.sum(), by_expert.sum())), torch.Generator().manual_seed(int(seed))
        shown[_IS_PAD] = ~_kept(is_shown, n, generator)
        corrections[_IS_PAD] = ~_kept(by_expert, n, generator)
        return shown, corrections

    def is_learned(self, attempts: EpisodeStore) -> Tensor:
        """Which frames of attempts are learned from, (N,) bool."""
        return frames_learned_from(attempts, self._n_skipped)


class JoinedBatches(BalancedBatches):
    """Demonstrations that were there and attempts that are demonstrations: every frame alike, as if they were one dataset."""

    def take_in(self, attempts: EpisodeStore) -> None:
        if not frames_by_expert(attempts).all():
            raise InputError(
                "The intervention dataset holds frames that the policy chose, and --method.type=redo learns from whole "
                "demonstrations: give a dataset that this method made, or another --method.type."
            )
        k = self._windows.n_windows
        shown = run_weights(attempts, k)
        both = torch.cat([run_weights(self._demonstrations, k), shown])
        self._attempts = attempts
        self._from_attempts, self._from_both = RunSampler(shown, self._seed + 1), RunSampler(both, self._seed)

    def batch(self, number: int) -> Batch:
        assert self._attempts is not None
        last, n = self._from_both.draw(self._batch_size, number), len(self._demonstrations)
        demonstrations = self._windows.batch(self._demonstrations, last[last < n])
        return joined(demonstrations, self._windows.batch(self._attempts, last[last >= n] - n))

    def halves(self, number: int) -> tuple[Batch, Batch]:
        assert self._attempts is not None
        pairs = ((self._demonstrations, self._from_demonstrations), (self._attempts, self._from_attempts))
        first, second = (self._windows.batch(store, own.draw(self._batch_size // 2, number)) for store, own in pairs)
        return first, second


def intervention_run_weights(store: EpisodeStore, n_windows: int, is_learned: Tensor) -> Tensor:
    """How often to draw the run that ends at each frame, so that every frame that is learned from counts alike.

    Where such frames follow each other K times or more, runs lie inside; shorter stretches have one run that holds them whole.

    Args:
        store: Attempts.
        n_windows: K, the windows per run.
        is_learned: (N,) bool, the frames that are learned from.

    Returns:
        (N,) float64, 0 for frames at which no run ends.
    """
    weights = np.zeros(len(store))
    for start, end in zip(store.starts, store.ends, strict=True):
        for first, after in stretches(is_learned[start:end].numpy()) + start:
            length = after - first
            if length < n_windows:
                weights[min(max(after, start + n_windows), end) - 1] += n_windows
                continue
            weights[first + n_windows - 1 : after] += 1
            for end_of_run in (first + n_windows - 1, after - 1):  # the same one if the stretch is a single run
                weights[end_of_run] += (n_windows - 1) / 2  # see `run_weights`
    return torch.from_numpy(weights)


def frames_learned_from(store: EpisodeStore, n_skipped: int) -> Tensor:
    """The frames that an expert chose, without the first ones of every correction, (N,) bool. All, if none were left.

    Where an episode begins with the expert, the policy has done nothing that it could remember: none is left out.
    """
    by_expert = frames_by_expert(store)
    later = by_expert.clone()
    for start, end in zip(store.starts, store.ends, strict=True):
        for first, after in stretches(by_expert[start:end].numpy()) + start:
            if first > start:
                later[first : min(first + n_skipped, after)] = False
    if by_expert.any() and not later.any():
        logging.warning(
            f"No correction is longer yet than the {n_skipped} frames that are ignored at its start (--skip_s). Until one is, "
            "corrections are used whole."
        )
        return by_expert
    return later


def frames_by_expert(store: EpisodeStore) -> Tensor:
    """Which frames of attempts have an action that the expert chose, (N,) bool, on the host."""
    return store.column(INTERVENTION).reshape(len(store), -1)[:, 0].bool().cpu()


def joined(first: Batch, second: Batch) -> Batch:
    """Two batches as one."""
    both = {key: (first[key], second[key]) for key in first if key in second}
    return {key: torch.cat([a, b]) if isinstance(a, Tensor) else [*a, *b] for key, (a, b) in both.items()}


def _kept(mask: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """`mask` with only n of its True left, chosen at random; all if there are fewer."""
    chosen = mask.flatten().nonzero().squeeze(1)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[:n].to(chosen.device)]
    kept = torch.zeros_like(mask.flatten())
    kept[chosen] = True
    return kept.view_as(mask)
