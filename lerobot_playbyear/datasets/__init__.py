"""Datasets with sound: their contract, an in-memory store of episodes, and what to draw from it."""

from typing import TYPE_CHECKING

from lerobot_playbyear import lazy_names
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

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.episode_store import EpisodeStore
    from lerobot_playbyear.datasets.samplers import RunSampler, run_weights

__all__ = [
    "AUDIO_PREFIX",
    "EpisodeStore",
    "RunSampler",
    "audio_feature",
    "audio_keys",
    "check_audio_features",
    "check_dataset_files",
    "cut_into_frames",
    "episode_waveform",
    "note_episode_start",
    "read_audio",
    "resample",
    "run_weights",
    "write_audio",
    "write_wav",
]

_WITH_TORCH = {
    "episode_store": ("EpisodeStore",),
    "samplers": ("RunSampler", "run_weights"),
}
__getattr__ = lazy_names(__name__, _WITH_TORCH)
