"""The film of an episode that was played with `watch=env.render`."""

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.episodes.episode import Episode, Observation
from lerobot_playbyear.film.video import amplify, at_a_rate_of_aac, compose, episode_sound, inset, write_film

_AUDIO = "audio."  # how raw observations name microphones


def write_episode_film(episode: Episode, path: Path, fps: int) -> None:
    """Writes a film with the policy's camera in a corner, the spectrogram below, and the sound as loud as it can be.

    Args:
        episode: Has watched T + 1 pictures (H, W, 3) uint8; its sound is int16. Microphones of another rate than the
            first one's are not heard.
        path: Of the film, an mp4.
        fps: Steps per second.
    """
    blocks = np.stack([_sound(observation) for observation in episode.observations])  # (T + 1, S, n_microphones)
    heard, sample_rate = at_a_rate_of_aac(amplify(episode_sound(blocks)), blocks.shape[1] * fps)
    sound = heard[:]
    views = [_first_camera(observation) for observation in episode.observations]
    pictures = (p if v is None else inset(p, v) for p, v in zip(episode.watched, views, strict=True))
    write_film(path, compose(pictures, len(views), sound, sample_rate), fps, sound, sample_rate)


def _first_camera(observation: Observation) -> np.ndarray | None:
    pixels: Any = observation.get("pixels")
    return next(iter(pixels.values()), None) if isinstance(pixels, dict) else pixels


def _sound(observation: Observation) -> np.ndarray:
    """(S, n_microphones) int16, of those with the first one's rate; without one (0, 0)."""
    blocks = [block for key, block in observation.items() if key.startswith(_AUDIO)]
    blocks = [block for block in blocks if len(block) == len(blocks[0])]
    return np.stack(blocks, axis=-1) if blocks else np.zeros((0, 0), np.int16)
