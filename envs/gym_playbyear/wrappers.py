"""Observations for learners that take one dictionary of arrays."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

_FULL_SCALE = 32768.0  # int16


def flat(nested: Mapping[str, Any]) -> dict[str, Any]:
    """What is in dictionaries within a dictionary, in one; dots join their keys."""
    found: dict[str, Any] = {}
    for key, value in nested.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{name}": part for name, part in flat(value).items()}
        else:
            found[key] = value
    return found


class FlatObservation(gym.ObservationWrapper):
    """Observations as Stable-Baselines3's `MultiInputPolicy` takes them: one dictionary, whose keys have no dots.

    `pixels_front` is `pixels["front"]`, (size, size, 3) uint8; `audio_gripper` is `audio.gripper`, (samples,) float32 in
    [-1, 1] instead of int16. All else keeps its shape and type. Of any environment whose observations are dictionaries.

    Args:
        env: The environment.

    Raises:
        TypeError: Its observations are no dictionaries.
    """

    def __init__(self, env: gym.Env):
        super().__init__(env)
        if not isinstance(env.observation_space, spaces.Dict):
            raise TypeError(
                f"FlatObservation needs observations in a dictionary, got {env.observation_space}: leave it out."
            )
        found = _without_dots(env.observation_space)
        sound = {key: spaces.Box(-1.0, 1.0, space.shape, np.float32) for key, space in found.items() if _is_pcm(space)}
        self._pcm = tuple(sound)
        self.observation_space = spaces.Dict(found | sound)

    def observation(self, observation: Any) -> dict[str, Any]:
        found = _without_dots(observation)
        return found | {key: (found[key] / _FULL_SCALE).astype(np.float32) for key in self._pcm}


def _without_dots(nested: Mapping[str, Any]) -> dict[str, Any]:
    return {key.replace(".", "_"): value for key, value in flat(nested).items()}


def _is_pcm(space: spaces.Space) -> bool:
    return space.dtype == np.int16
