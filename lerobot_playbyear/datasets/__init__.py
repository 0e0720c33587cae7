"""Datasets with sound: their contract, and reading and writing them."""

from lerobot_playbyear.datasets.features import (
    AUDIO_PREFIX,
    audio_feature,
    audio_keys,
    check_audio_features,
    episode_waveform,
)
from lerobot_playbyear.datasets.info import check_dataset_files

__all__ = [
    "AUDIO_PREFIX",
    "audio_feature",
    "audio_keys",
    "check_audio_features",
    "check_dataset_files",
    "episode_waveform",
]
