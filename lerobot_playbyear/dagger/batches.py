"""Balanced batches: half of the windows from demonstrations, half from moments in which an expert was in control.

A training item holds several actions: of K windows that share encodings (`RunSampler`), or of a chunk. An expert's stretch of
control rarely begins or ends where an item does, so actions are masked one by one, by LeRobot's `action_is_pad`: as many
actions of demonstrations are supervised as there are actions that the expert chose, and all weigh the same.
"""

import logging
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.datasets import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.frames import INTERVENTION
from lerobot_playbyear.training.windows import PolicyWindows

_IS_PAD = f"{ACTION}_is_pad"


class BalancedBatches:
    """Draws batches from two stores.

    Each batch has random numbers of its own, seeded with the seed and its number: resuming needs that number alone.

    Args:
        windows: Cuts the policy's windows.
        demonstrations: All of whose frames are learned from.
        interventions: Whole attempts, with the column `intervention`; only what the expert chose is learned from. None
            while there are none.
        batch_size: Runs per batch, even: half of them from each store.
        seed: Of the random numbers.
        n_skipped: Frames at the beginning of every correction that are not learned from, see `frames_learned_from`.

    Raises:
        InputError: No frame of `interventions` is an intervention.
    """

    def __init__(
        self,
        windows: PolicyWindows,
        demonstrations: EpisodeStore,
        interventions: EpisodeStore | None,
        batch_size: int,
        seed: int = 0,
        n_skipped: int = 0,
    ) -> None:
        self._windows, self._seed, self._n_half = windows, seed, batch_size // 2
        self._n_skipped = n_skipped
        self._demonstrations = demonstrations
        self._from_demonstrations = RunSampler(run_weights(demonstrations, windows.n_windows), seed)
        self._interventions: EpisodeStore | None = None
        if interventions is not None:
            self.set_interventions(interventions)

    def set_interventions(self, interventions: EpisodeStore) -> None:
        """Take in a store, or the episodes that were appended to it since the last time.

        Raises:
            InputError: No frame is an intervention.
        """
        self._is_learned = frames_learned_from(interventions, self._n_skipped).cpu()
        weights = intervention_run_weights(interventions, self._windows.n_windows, self._is_learned)
        if not weights.any():
            raise InputError(
                f"None of the {len(interventions)} frames of the intervention dataset has '{INTERVENTION}' set: there is "
                "nothing to learn from an expert. Give a dataset of corrections, or collect some with --episodes."
            )
        self._interventions, self._from_interventions = interventions, RunSampler(weights, self._seed + 1)

    def n_expert_frames(self) -> tuple[int, int]:
        """How many of the frames that the expert chose are learned from, and how many there are."""
        if self._interventions is None:
            return 0, 0
        by_expert = frames_by_expert(self._interventions).cpu()
        return int((by_expert & self._is_learned).sum()), int(by_expert.sum())

    def n_attempts_without(self) -> tuple[int, int]:
        """In how many attempts the expert acted and nothing is learned from, and how many there are."""
        store = self._interventions
        if store is None:
            return 0, 0
        by_expert = frames_by_expert(store).cpu()
        spans = [slice(start, end) for start, end in zip(store.starts, store.ends, strict=True)]
        n_without = sum(bool(by_expert[span].any() and not self._is_learned[span].any()) for span in spans)
        return n_without, len(spans)

    def batch(self, number: int) -> dict[str, Any]:
        """The batch of that number, counted from 0: the first half are demonstrations.

        Returns:
            What `PolicyWindows.batch` gives; with several actions per item `action_is_pad` (B, K) is also true where an
            action is not to be learned.
        """
        assert self._interventions is not None
        last = draw(self._from_interventions, number, self._n_half)
        interventions = self._windows.batch(self._interventions, last)
        demonstrations = self._windows.batch(
            self._demonstrations, draw(self._from_demonstrations, number, self._n_half)
        )
        if len(self._windows.action_deltas) > 1:
            is_learned = ~demonstrations[_IS_PAD]  # (B/2, K)
            by_expert = (
                of_actions(self._is_learned, last, self._windows).to(is_learned.device) & ~interventions[_IS_PAD]
            )
            n, generator = int(min(is_learned.sum(), by_expert.sum())), self._generator(number)
            demonstrations[_IS_PAD] = ~keep(is_learned, n, generator)
            interventions[_IS_PAD] = ~keep(by_expert, n, generator)
        common = [key for key in demonstrations if key in interventions]
        return {key: concatenated(demonstrations[key], interventions[key]) for key in common}

    def halves(self, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """A batch of demonstrations and one of interventions, to tell their losses apart."""
        batch = self.batch(number)
        return ({k: v[: self._n_half] for k, v in batch.items()}, {k: v[self._n_half :] for k, v in batch.items()})

    def _generator(self, number: int) -> torch.Generator:
        seed = np.random.SeedSequence([self._seed + 2, number]).generate_state(1, np.uint64)[0]
        return torch.Generator().manual_seed(int(seed))


def intervention_run_weights(store: EpisodeStore, n_windows: int = 1, is_learned: Tensor | None = None) -> Tensor:
    """How often to draw the run that ends at each frame, so that every intervention frame is learned from alike.

    Where the expert was in control for K frames or longer, runs lie inside; shorter stretches have one run that holds
    them whole.

    Args:
        store: Attempts with the column `intervention`.
        n_windows: K, the windows per run.
        is_learned: (N,) bool, the frames that are learned from; None: all interventions.

    Returns:
        (N,) float64, 0 for frames at which no run ends.
    """
    by_expert = (frames_by_expert(store) if is_learned is None else is_learned).cpu().numpy()
    weights = np.zeros(len(store))
    for start, end in zip(store.starts, store.ends, strict=True):
        for first, after in stretches(by_expert[start:end]) + start:
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
    later = by_expert.cpu().numpy().copy()
    for start, end in zip(store.starts, store.ends, strict=True):
        for first, after in stretches(later[start:end]) + start:
            if first > start:
                later[first : min(first + n_skipped, after)] = False
    if later.any():
        return torch.from_numpy(later).to(by_expert.device)
    if by_expert.any():
        logging.warning(
            f"No correction is longer than the {n_skipped} frames that are left out at the beginning of each (--skip_s) so "
            "far: for now all of them is learned from."
        )
    return by_expert


def stretches(flags: np.ndarray) -> np.ndarray:
    """Where flags (T,) are true without a gap, (n, 2): the first frame of each stretch, and the one after its last."""
    return np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]))).reshape(-1, 2)


def frames_by_expert(store: EpisodeStore) -> Tensor:
    """Which frames of attempts have an action that the expert chose, (N,) bool."""
    return store.column(INTERVENTION).reshape(len(store), -1)[:, 0].bool()


def of_actions(values: Tensor, last: Tensor, windows: PolicyWindows) -> Tensor:
    """What is said of frames, (N,), for the K actions of the items at the frames `last`, (B, K)."""
    frames = last.unsqueeze(1) + torch.tensor(windows.action_deltas)
    return values[frames.clamp(0, len(values) - 1)]


def draw(sampler: RunSampler, number: int, n: int) -> Tensor:
    """The last frames (n,) of the runs of the batch of that number, counted from 0."""
    sampler.load_state_dict({**sampler.state_dict(), "n_batches": number})
    return sampler.draw(n)


def keep(mask: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """`mask` with only n of its True left, chosen at random; all if there are fewer."""
    chosen = mask.flatten().nonzero().squeeze(1)
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[:n].to(chosen.device)]
    kept = torch.zeros_like(mask.flatten())
    kept[chosen] = True
    return kept.view_as(mask)


def concatenated(first: Any, second: Any) -> Any:
    """Two batches' values of one key as one."""
    return torch.cat([first, second]) if isinstance(first, Tensor) else [*first, *second]
