"""Batches: which runs of frames are drawn, what is cut out for each, and how processes share them.

A training item is a run of K windows, named by its last frame: its windows end at that frame and at the K - 1 frames before.
"""

import copy
import itertools
import logging
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.datasets.features import audio_keys, check_audio_features
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.store import EpisodeStore, features_at, sample_rate_in

if TYPE_CHECKING:
    from accelerate import Accelerator

Batch = dict[str, Any]

Renamed = Mapping[str, str] | None
"""The dataset's names of observations, with what the policy calls them."""

_AHEAD = 2


def make_batches(
    accelerator: "Accelerator", windows: "PolicyWindows", store: EpisodeStore, n_items: int, seed: int, first: int = 0
) -> Iterator[Batch]:
    """This process's share of every batch, without end.

    All processes draw the same runs, so that together they have those of one process.

    Args:
        accelerator: Of the processes.
        windows: Cut the items.
        store: The episodes.
        n_items: Of a process per update.
        seed: Of the draws.
        first: Number of the first batch; a run that goes on continues with that of its next update.
    """
    sampler = RunSampler(run_weights(store, windows.n_windows), seed)
    n_all = n_items * accelerator.num_processes
    share = slice(accelerator.process_index, None, accelerator.num_processes)
    batches = (windows.batch(store, sampler.draw(n_all, number)[share]) for number in itertools.count(first))
    if accelerator.device.type == "cuda" and store.device.type == "cpu":
        return prefetched(pinned(batch) for batch in batches)
    return batches


class RunSampler:
    """Draws runs in proportion to their weights, spread over the whole store.

    A batch of B is drawn with one run in each B-th part of the total weight, so that it comes from as many episodes
    as there are. Every batch has a generator of its own, seeded with the seed and its number: resuming needs that number alone.

    Args:
        weights: (N,) the weight of the run that ends at each frame; at least one above 0.
        seed: Of the random numbers.

    Raises:
        ValueError: If a weight is negative or not finite, or all are 0.
    """

    def __init__(self, weights: Tensor, seed: int = 0) -> None:
        weights = weights.to("cpu", torch.float64)
        if weights.ndim != 1 or not weights.isfinite().all() or (weights < 0).any() or weights.sum() <= 0:
            raise ValueError("Weights must be one finite number >= 0 per frame, and not all of them 0.")
        self._seed = seed
        self._frames = weights.nonzero().squeeze(1)
        self._cumulative = weights[self._frames].cumsum(0)

    def draw(self, n: int, number: int) -> Tensor:
        """The last frames of the runs of a batch, (n,) int64, in random order.

        Args:
            n: Runs.
            number: Of the batch, counted from 0.
        """
        seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1, np.uint64)[0])
        generator = torch.Generator().manual_seed(seed)
        within = torch.rand(n, generator=generator, dtype=torch.float64)
        shift = torch.rand(1, generator=generator, dtype=torch.float64)
        places = (torch.randperm(n, generator=generator) + within) / n + shift
        position = torch.searchsorted(self._cumulative, (places % 1.0) * self._cumulative[-1], right=True)
        return self._frames[position.clamp_(max=len(self._frames) - 1)]


def run_weights(store: EpisodeStore, n_windows: int = 1) -> Tensor:
    """How often to draw the run that ends at each frame, so that all frames are learned from alike.

    Runs that would reach before the episode are not drawn. Only one run holds the first frame, and only one the last, whereas
    K hold one in the middle: the first and the last run of an episode weigh (K + 1) / 2 to make up for it.

    Args:
        store: The episodes.
        n_windows: K, the windows per run.

    Returns:
        (N,) float64, 0 for frames at which no run ends.
    """
    weights = torch.zeros(len(store), dtype=torch.float64)
    for start, end in zip(store.starts, store.ends, strict=True):
        k = min(n_windows, end - start)
        weights[start + k - 1 : end] = 1
        weights[start + k - 1] += (k - 1) / 2
        weights[end - 1] += (k - 1) / 2
    return weights


class PolicyWindows:
    """Cuts the batches a policy trains on out of stores: observations as far back as each is looked at, bytes and 16-bit sound.

    Args:
        policy: The policy's configuration, complete with its features.
        meta: The dataset's metadata; of sound at the rate at which it is to be cut out.
        rename_map: The dataset's names of observations, with what the policy calls them.

    Attributes:
        keys: The features that a store has to hold.
        sample_rates: At which each microphone is cut out [Hz]; of those alone whose feature says it.
        image_size: Height and width at which the policy looks at pictures [pixels].
        n_windows: Windows per item that lie in a run of frames, K.
        action_deltas: Where the actions of an item lie, in frames from its last one.
    """

    def __init__(self, policy: PlaybyearConfig, meta: LeRobotDatasetMetadata, rename_map: Renamed = None) -> None:
        names = dataset_names(policy, rename_map)
        self._deltas = {names[key]: list(range(1 - n, 1)) for key, n in _history(policy).items()}
        self._deltas[ACTION] = self.action_deltas = list(policy.action_delta_indices)
        self.keys = list(self._deltas)
        rates = {key: sample_rate_in(meta.features[key]) for key in audio_keys(meta.features)}
        self.sample_rates = {key: rate for key, rate in rates.items() if rate is not None}
        self.image_size, self.n_windows = policy.image_size, policy.n_supervised_steps

    def batch(self, store: EpisodeStore, last_frames: Tensor) -> Batch:
        """The training items whose last frames are `last_frames` (B,), on the store's device."""
        return store.windows(last_frames, self._deltas)


def dataset_names(policy: PlaybyearConfig, rename_map: Renamed = None) -> dict[str, str]:
    """What the dataset calls each observation of the policy."""
    original = {renamed: key for key, renamed in (rename_map or {}).items()}
    return {key: original.get(key, key) for key in policy.input_features or {}}


def _history(policy: PlaybyearConfig) -> dict[str, int]:
    """How many frames of each observation a training item holds."""
    return {
        **dict.fromkeys(policy.camera_keys if policy.use_vision else [], policy.n_image_frames),
        **dict.fromkeys(audio_keys(policy.input_features or {}) if policy.use_audio else [], policy.n_audio_frames),
        **dict.fromkeys(policy.low_dimensional_keys, policy.n_run_frames),
    }


def learned_meta(policy: PlaybyearConfig, meta: LeRobotDatasetMetadata) -> LeRobotDatasetMetadata:
    """The metadata that a policy is made for: sound at the rate at which it is learned from.

    Returns:
        `meta` itself where nothing of it changes.

    Raises:
        ValueError: The frame rate does not divide the policy's sample rate.
    """
    if not policy.use_audio or policy.sample_rate is None:
        return meta
    features = features_at(meta.features, dict.fromkeys(audio_keys(meta.features), policy.sample_rate), meta.fps)
    changed = [key for key in features if features[key] is not meta.features[key]]
    if not changed:
        return meta
    check_audio_features({key: meta.features[key] for key in changed}, meta.fps)
    logging.info(f"'{meta.repo_id}': {', '.join(changed)} resampled to {policy.sample_rate} Hz")
    meta = copy.copy(meta)
    meta.info = copy.copy(meta.info)
    meta.info.features = features
    return meta


def runs_of_each_frame(store: EpisodeStore, n_windows: int) -> Tensor:
    """The last frames of runs of K windows in which every frame lies once; the first run of an episode may be shorter."""
    bounds = zip(store.starts, store.ends, strict=True)
    return torch.cat([torch.arange(end - 1, start - 1, -n_windows) for start, end in bounds])


def prefetched(batches: Iterator[Batch]) -> Iterator[Batch]:
    """The same, made in a thread, two ahead of the one that is learned from.

    Raises:
        Exception: What making a batch raises, when it is wanted.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="batches")
    try:
        waiting = deque(pool.submit(next, batches) for _ in range(_AHEAD))
        while True:
            waiting.append(pool.submit(next, batches))
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def pinned(batch: Mapping[str, Any]) -> Batch:
    """The batch in memory that a GPU reads by itself, so that copying it holds up nothing."""
    return {key: value.pin_memory() if isinstance(value, Tensor) else value for key, value in batch.items()}
