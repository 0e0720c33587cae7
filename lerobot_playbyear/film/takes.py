"""Episodes played for people: their pictures and their sound."""

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_playbyear.episodes.episode import Observation
from lerobot_playbyear.episodes.play import Actor, play
from lerobot_playbyear.film.video import amplify, compose, episode_sound, inset, write_film

_AUDIO = "audio."


@dataclass
class Take:
    """One filmed episode of T steps.

    Args:
        seed: Of the episode.
        success: Whether the task was solved.
        pictures: T + 1 pictures (H, W, 3) uint8, with the policy's camera in a corner.
        blocks: (T + 1, S, n_microphones) int16, the sound of each observation.
    """

    seed: int
    success: bool
    pictures: list[np.ndarray]
    blocks: np.ndarray


def takes(env: gym.Env, actor: Actor, seeds: Iterable[int]) -> Generator[Take]:
    """Films one episode per seed.

    Args:
        env: Its `render()` gives the pictures.
        actor: Who acts: `Script` or `PolicyActor`.

    Raises:
        RolloutError: The environment has no such script.
    """
    for seed in seeds:
        episode = play(env, actor, seed, watch=env.render)
        blocks = np.stack([_sound(observation) for observation in episode.observations])
        views = [_first_camera(observation) for observation in episode.observations]
        shown = [p if v is None else inset(p, v) for p, v in zip(episode.watched, views, strict=True)]
        yield Take(seed, episode.success, shown, blocks)


def write_take(take: Take, path: Path, fps: int) -> None:
    """Writes a film with its sound, as loud as it can be, and the spectrogram below the picture."""
    sample_rate = take.blocks.shape[1] * fps or 16000
    sound = amplify(episode_sound(take.blocks))
    write_film(path, compose(take.pictures, len(take.pictures), sound, sample_rate), fps, sound, sample_rate)


def _first_camera(observation: Observation) -> np.ndarray | None:
    pixels: Any = observation.get("pixels")
    return next(iter(pixels.values()), None) if isinstance(pixels, dict) else pixels


def _sound(observation: Observation) -> np.ndarray:
    """(S, n_microphones) int16; without one (0, 0)."""
    blocks = [block for key, block in observation.items() if key.startswith(_AUDIO)]
    return np.stack(blocks, axis=-1) if blocks else np.zeros((0, 0), np.int16)
