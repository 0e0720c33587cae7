"""Datasets with sound: their contract, and reading and writing them."""

from lerobot_playbyear.datasets.audio_files import cut_into_frames, read_audio, resample, write_audio, write_wav
from lerobot_playbyear.datasets.episode_clock import note_episode_start
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
    "cut_into_frames",
    "episode_waveform",
    "note_episode_start",
    "read_audio",
    "resample",
    "write_audio",
    "write_wav",
]
