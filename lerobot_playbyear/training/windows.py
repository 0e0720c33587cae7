"""The batches that a policy trains on, cut out of stores."""

import copy
import logging
from collections.abc import Mapping
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata, resolve_delta_timestamps
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_playbyear.datasets import audio_keys, check_audio_features
from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.datasets.resampling import features_at, sample_rate_in
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


class PolicyWindows:
    """Cuts the batches a policy trains on out of stores.

    The policy `playbyear` gets its observations only as far back as each is looked at, as bytes and 16-bit sound;
    other policies get exactly what LeRobot's data loader would give them.

    Args:
        policy: The policy's configuration, complete with its features.
        meta: The dataset's metadata; of sound at the rate at which it is to be cut out.
        rename_map: The dataset's names of observations, with what the policy calls them.

    Attributes:
        image_size: Height and width at which the policy looks at pictures [pixels]; None: as they are recorded.
        n_windows: Windows per item that lie in a run of frames, K.
        n_dropped: How many of the last frames of every episode the policy does not learn from, its `drop_n_last_frames`.
        action_deltas: Where the actions of an item lie, in frames from its last or, of a chunk, its first one; empty for a
            policy that learns single actions.
    """

    def __init__(
        self, policy: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str] | None = None
    ) -> None:
        self._meta = meta
        self._as_lerobot = not isinstance(policy, PlaybyearConfig)
        if isinstance(policy, PlaybyearConfig):
            names = dataset_names(policy, rename_map)
            self._deltas = {names[key]: list(range(1 - n, 1)) for key, n in _history(policy).items()}
            self._deltas[ACTION] = list(policy.action_delta_indices)
        else:
            timestamps = resolve_delta_timestamps(policy, meta) or {}
            self._deltas = {key: [round(t * meta.fps) for t in times] for key, times in timestamps.items()}
        self.image_size = policy.image_size if isinstance(policy, PlaybyearConfig) else None
        self.n_windows: int = getattr(policy, "n_supervised_steps", 1)
        self.n_dropped: int = getattr(policy, "drop_n_last_frames", None) or 0
        self.action_deltas: list[int] = self._deltas.get(ACTION, [])

    @property
    def keys(self) -> list[str] | None:
        """The features that a store has to hold; None means all that it can."""
        return None if self._as_lerobot else list(self._deltas)

    @property
    def sample_rates(self) -> dict[str, int]:
        """The rate at which each microphone is cut out [Hz]; of those alone whose feature says it."""
        rates = {key: sample_rate_in(self._meta.features[key]) for key in audio_keys(self._meta.features)}
        return {key: rate for key, rate in rates.items() if rate is not None}

    def check_lengths(self, dataset: LeRobotDataset) -> None:
        """Refuse a dataset of which no frame would be drawn.

        Raises:
            ValueError: No episode is longer than what the policy drops of each.
        """
        lengths = dataset.meta.episodes["length"]
        used = range(dataset.num_episodes) if dataset.episodes is None else dataset.episodes
        longest = max((int(lengths[episode]) for episode in used), default=0)
        if longest <= self.n_dropped:
            raise ValueError(
                f"--policy.drop_n_last_frames={self.n_dropped} leaves no frame of '{dataset.repo_id}', whose longest "
                f"episode has {longest}; wanted fewer than that. Give less, or a dataset with longer episodes."
            )

    def batch(self, store: EpisodeStore, last_frames: Tensor) -> dict[str, Any]:
        """The training items whose last frames are `last_frames` (B,), on the store's device."""
        return store.windows(last_frames, self._deltas, as_lerobot=self._as_lerobot)


def dataset_names(policy: PreTrainedConfig, rename_map: Mapping[str, str] | None = None) -> dict[str, str]:
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


def learned_meta(policy: PreTrainedConfig, meta: LeRobotDatasetMetadata) -> LeRobotDatasetMetadata:
    """The metadata that a policy is made for: sound at the rate at which it is learned from.

    Returns:
        `meta` itself where nothing of it changes.

    Raises:
        ValueError: The frame rate does not divide the policy's sample rate.
    """
    if not (isinstance(policy, PlaybyearConfig) and policy.use_audio and policy.sample_rate is not None):
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
