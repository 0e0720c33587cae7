"""Episodes played for people: their pictures and their sound."""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_IMAGE, OBS_STR

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.episodes.acting import RolloutParts
from lerobot_playbyear.episodes.rollouts import roll_out
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


def script_takes(env: gym.Env, seeds: Iterable[int], baseline: str | None = None) -> Generator[Take]:
    """Films episodes of an environment's expert, or of the blind baseline of that name.

    Raises:
        RolloutError: The environment has no such script.
    """
    for seed in seeds:
        episode = roll_out(env, seed, actor=baseline, pictures=True)
        keys = [key for key in episode.observations[0] if key.startswith(_AUDIO)]
        sounds = [np.stack([observation[key] for observation in episode.observations]) for key in keys]
        views = [_first_camera(observation) for observation in episode.observations]
        pictures = _with_views(episode.pictures, views)
        yield Take(seed, episode.success, pictures, _stack(sounds, len(pictures)))


def policy_takes(env: gym.vector.VectorEnv, parts: RolloutParts, seeds: Iterable[int]) -> Generator[Take]:
    """Films episodes of a policy.

    Args:
        env: A vector environment of one, as LeRobot's `make_env` makes it.
        parts: The policy, loaded for it.
        seeds: One episode each.
    """
    for seed in seeds:
        pictures: list[np.ndarray] = []
        with torch.no_grad():
            result = rollout(
                env,
                *parts.in_order(),
                seeds=[seed],
                return_observations=True,
                render_callback=lambda env, kept=pictures: kept.append(env.call("render")[0]),
            )
        observations = result[OBS_STR]  # as preprocess_observation makes them: floats at PCM's full scale
        sounds = [observations[key][0].round().short().numpy() for key in audio_keys(observations)]
        cameras = [key for key in observations if key.startswith(OBS_IMAGE)]
        views = [_to_picture(view) for view in observations[cameras[0]][0]] if cameras else []
        shown = _with_views(pictures, views)
        yield Take(seed, bool(result["success"].any()), shown, _stack(sounds, len(shown)))


def write_take(take: Take, path: Path, fps: int) -> None:
    """Writes a film with its sound, as loud as it can be, and the spectrogram below the picture."""
    sample_rate = take.blocks.shape[1] * fps or 16000
    sound = amplify(episode_sound(take.blocks))
    write_film(path, compose(take.pictures, len(take.pictures), sound, sample_rate), fps, sound, sample_rate)


def _first_camera(observation: dict[str, Any]) -> np.ndarray | None:
    pixels = observation.get("pixels")
    return next(iter(pixels.values()), None) if isinstance(pixels, dict) else pixels


def _to_picture(view: torch.Tensor) -> np.ndarray:
    """(3, h, w) in [0, 1] -> (h, w, 3) uint8."""
    return (view.permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()


def _with_views(pictures: list[np.ndarray], views: Sequence[np.ndarray | None]) -> list[np.ndarray]:
    if not views or any(view is None for view in views):
        return pictures
    return [inset(picture, view) for picture, view in zip(pictures, views, strict=True) if view is not None]


def _stack(sounds: list[np.ndarray], n_frames: int) -> np.ndarray:
    """(T + 1, S) of each microphone -> (T + 1, S, n_microphones); without one (T + 1, 0, 0)."""
    return np.stack(sounds, axis=-1) if sounds else np.zeros((n_frames, 0, 0), np.int16)
