"""Pictures of sound while a policy acts: the environment itself makes them, as it does its cameras' pictures.

A step of LeRobot's environment processor would be the other place, but it would have to remember the last seconds, and
LeRobot's `rollout` resets policies and environments, never their processors: the second episode would begin with the sound of
the first. An environment knows when its episode begins. The picture is one more entry of `pixels`, and everything after it
(vector environments in one process or in several, `preprocess_observation`, the policy's normalisation) is LeRobot's own.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lerobot_playbyear.audio.sound_picture import HeardSound, SoundPicture, read_pictures
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX

_PIXELS = "pixels"


class WithSoundPictures(gym.ObservationWrapper):
    """An environment that shows what its microphones heard, `pixels[<name>]`, (height, width, 3) uint8.

    Args:
        env: An environment whose observations are a Dict with `audio.<microphone>`, (S,) int16, and `pixels` as a Dict or none.
        pictures: How they are made: `pictures_for`.
    """

    def __init__(self, env: gym.Env, pictures: Sequence[SoundPicture]) -> None:
        super().__init__(env)
        self._heard = {(how.microphone.removeprefix("observation."), how.name): HeardSound(how) for how in pictures}
        assert isinstance(env.observation_space, spaces.Dict)
        pixels = env.observation_space.spaces.get(_PIXELS)
        cameras = dict(pixels.spaces) if isinstance(pixels, spaces.Dict) else {}
        own = {how.name: spaces.Box(0, 255, (how.height, how.width, 3), np.uint8) for how in pictures}
        self.observation_space = spaces.Dict({**env.observation_space.spaces, _PIXELS: spaces.Dict({**cameras, **own})})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        for heard in self._heard.values():
            heard.clear()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Any) -> dict[str, Any]:
        """The frame's observation with the pictures; the one given stays as it is."""
        own = {name: heard.add(np.asarray(observation[key])) for (key, name), heard in self._heard.items()}
        return {**observation, _PIXELS: {**observation.get(_PIXELS, {}), **own}}


def with_sound_pictures(make: Callable[[], gym.Env], pictures: Sequence[SoundPicture]) -> Callable[[], gym.Env]:
    """What makes an environment with these pictures, if there are any, from what makes it without; it can be pickled."""
    return partial(_make, make, tuple(pictures)) if pictures else make


def pictures_for(
    path: str | Path, sample_rates: Mapping[str, int], fps: int, cameras: Sequence[str]
) -> list[SoundPicture]:
    """The pictures of a dataset, for an environment.

    Args:
        path: The dataset's folder, or its `meta/info.json`.
        sample_rates: Of the environment's microphones [Hz], by their names.
        fps: Its frames per second [Hz].
        cameras: Its other pictures.

    Raises:
        InputError: They cannot be made from what this environment hears.
    """
    pictures = read_pictures(path)
    for how in pictures:
        microphone = how.microphone.removeprefix(AUDIO_PREFIX)
        if microphone not in sample_rates:
            heard = ", ".join(sample_rates) or "none"
            raise InputError(f"{path} has pictures of the microphone '{microphone}'; the environment has {heard}")
        for name, seen, wanted in (("sample_rate", sample_rates[microphone], how.sample_rate), ("fps", fps, how.fps)):
            if seen != wanted:
                raise InputError(f"{path} shows '{microphone}' with {name}={wanted}; the environment has {seen}")
        if how.name in cameras:
            raise InputError(
                f"{path} has pictures of '{microphone}' that are called '{how.name}', as a camera of the environment is; "
                "attach them with another --name"
            )
    return pictures


def _make(make: Callable[[], gym.Env], pictures: Sequence[SoundPicture]) -> gym.Env:
    return WithSoundPictures(make(), pictures)
