"""Whether features can become a dataset with sound, and frames an episode of it, said before anything is written."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.datasets.feature_utils import get_hf_features_from_features, validate_frame

from lerobot_playbyear.datasets.audio_feature import audio_keys, check_audio_features
from lerobot_playbyear.datasets.errors import InputError, errors_of_input


def check_features(features: Mapping[str, Mapping[str, Any]], fps: int) -> None:
    """Whether a dataset of these features can be written.

    Args:
        features: LeRobot features, without the ones LeRobot adds itself.
        fps: Frames per second.

    Raises:
        InputError: Naming the key, the value seen and the value wanted.
    """
    if not isinstance(fps, int) or isinstance(fps, bool) or fps < 1:
        raise InputError(f"fps={fps!r}: wanted a whole number of frames per second, 1 or more.")
    microphones = audio_keys(features)
    for key, feature in features.items():
        _check_shape(key, feature)
        if key not in microphones:
            _check_type(key, feature)
    check_audio_features(features, fps)
    for key in microphones:
        _check_rate(key, features[key])


def check_frame(frame: Mapping[str, Any], features: Mapping[str, Mapping[str, Any]]) -> None:
    """Whether a frame can become part of an episode.

    Args:
        frame: A numpy array of its dtype and shape per feature, and `task`.
        features: All features of the dataset.

    Raises:
        InputError: Naming the key, the value seen and the value wanted.
    """
    with errors_of_input():
        validate_frame(dict(frame), dict(features))
    if not isinstance(frame["task"], str):
        raise InputError(f"'task' is {frame['task']!r}; wanted a text that says what is done.")
    for key in audio_keys(features):
        sound = frame[key]
        if np.issubdtype(sound.dtype, np.floating):
            wrong = ~(np.abs(sound) <= 1)  # true for NaN
            if wrong.any():
                index = int(wrong.argmax())
                raise InputError(
                    f"'{key}': sample {index} is {sound[index]:g}; floats are sound in [-1, 1]. Divide integers by "
                    "their full scale (32768 for 16 bits), clip what is louder, and put 0 where nothing was heard."
                )


def _check_shape(key: str, feature: Mapping[str, Any]) -> None:
    for name in ("dtype", "shape"):
        if name not in feature:
            raise InputError(f"'{key}' has no {name}: give dtype, shape and names, as LeRobot's features have them.")
    shape = feature["shape"]
    sizes = shape if isinstance(shape, tuple | list) else [None]
    if not all(isinstance(size, int | np.integer) and size > 0 for size in sizes):
        raise InputError(f"'{key}' has shape {shape!r}; wanted a tuple of positive whole numbers.")
    if key in audio_keys([key]) and len(shape) > 1:
        n_channels = min(shape)
        advice = (
            f"wanted ({max(shape)},)"
            if n_channels == 1
            else f"every microphone is its own key: write {n_channels} features of shape ({max(shape)},), such as "
            f"'{key}_left' and '{key}_right'"
        )
        raise InputError(f"'{key}' has shape {tuple(shape)}; {advice}.")


def _check_type(key: str, feature: Mapping[str, Any]) -> None:
    """Whether LeRobot's files can hold a feature that is no sound."""
    own = {key: {**feature, "shape": tuple(feature["shape"])}}
    try:
        get_hf_features_from_features(own).arrow_schema  # noqa: B018  (raises for what it does not know)
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"'{key}' has dtype {feature['dtype']!r} and shape {feature['shape']!r}, which no dataset can hold: {error}"
        ) from error


def _check_rate(key: str, feature: Mapping[str, Any]) -> None:
    """A reader takes any number that is whole; what is written is plain."""
    rate = feature["info"]["sample_rate"]
    if not isinstance(rate, int) or isinstance(rate, bool):
        raise InputError(f"'{key}' has sample_rate {rate!r}; wanted a whole number of Hz, a Python int such as 16000.")
