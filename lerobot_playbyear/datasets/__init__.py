"""Datasets with sound: their contract, and reading and writing them."""

from lerobot_playbyear.datasets.features import audio_feature, audio_keys, episode_waveform

__all__ = ["audio_feature", "audio_keys", "episode_waveform"]
