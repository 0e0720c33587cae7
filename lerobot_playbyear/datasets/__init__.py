"""Datasets with sound: their contract, an in-memory store of episodes, and what to draw from it."""

from lerobot_playbyear.datasets.audio_feature import (
    AUDIO_PREFIX,
    audio_feature,
    audio_keys,
    check_audio_features,
    episode_waveform,
    write_wav,
)
from lerobot_playbyear.datasets.columns import check_dataset_files
from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.datasets.samplers import RunSampler, loud_frames, run_weights, start_frames

__all__ = [
    "AUDIO_PREFIX",
    "EpisodeStore",
    "RunSampler",
    "audio_feature",
    "audio_keys",
    "check_audio_features",
    "check_dataset_files",
    "episode_waveform",
    "loud_frames",
    "run_weights",
    "start_frames",
    "write_wav",
]
