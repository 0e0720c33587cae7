"""How a LeRobotDataset carries sound, and whether features and frames can become one.

Every microphone is one column `observation.audio.<microphone>`: a row holds the samples heard since the previous
frame, so its length is `sample_rate / fps`, an integer. Integers are PCM at full scale, floats are already in
[-1, 1]; the sample rate stands in the feature's `info`. Nothing here needs the policy: a dataset of this shape is
a plain LeRobotDataset v3.0.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from lerobot_playbyear.datasets.errors import InputError, errors_of_input
from lerobot_playbyear.datasets.frame_rate import divides, exact_rate, nearest_sample_rate
from lerobot_playbyear.datasets.parquet import column_to_numpy

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

Features = Mapping[str, Mapping[str, Any]]
"""LeRobot's features: what is said of each column, by its key."""

AUDIO_PREFIX = "observation.audio."
"""What the key of every microphone starts with."""

AUDIO_DTYPE = "audio"
"""Of a feature whose sound lies in files beside the frames, which is not our layout: see `audio.lerobot_audio`."""

INTERVENTION = "intervention"
"""LeRobot's column of the frames that an expert corrected."""

IS_FIRST = "is_first"
"""A column of datasets with pauses: the frames before which something was not recorded, each episode's first one included.
Memory and sound do not reach back beyond such a frame."""

IS_FIRST_FEATURE = {"dtype": "bool", "shape": (1,), "names": None}

MICROPHONE = "microphone"
"""Where the `info` of a microphone's pictures names its sound, `observation.audio.<microphone>`."""

PCM_S16 = "pcm_s16"
_PCM_S16_FULL_SCALE = 32768
_MOST_SAMPLES_PER_S = 1_000_000


def samples_per_frame(sample_rate: int, fps: float, key: str = AUDIO_PREFIX + "<microphone>") -> int:
    """The number of samples between two frames.

    Args:
        sample_rate: Samples per second [Hz].
        fps: Frames per second [Hz].
        key: The audio key, for the message.

    Raises:
        ValueError: If the frame rate does not divide the sample rate.
    """
    if fps <= 0:
        raise ValueError(f"'{key}': fps is {fps}; wanted a number above 0.")
    if not divides(fps, sample_rate):
        raise ValueError(
            f"'{key}': a frame must hold a whole number of samples, but sample_rate / fps = {sample_rate} / {fps} "
            f"is not a positive integer. Choose a sample rate that is a multiple of {exact_rate(fps).numerator} Hz, for "
            f"example {nearest_sample_rate(sample_rate, fps)} Hz, and resample the recording to it."
        )
    return int(sample_rate / exact_rate(fps))


def audio_feature(sample_rate: int, fps: float) -> dict[str, Any]:
    """The feature of one microphone for `LeRobotDataset.create(features=...)`: int16 PCM of shape (S,).

    Args:
        sample_rate: Samples per second [Hz], which `fps` divides.
        fps: Frames per second of the dataset [Hz].

    Raises:
        ValueError: If the frame rate does not divide the sample rate.
    """
    shape, info = (samples_per_frame(sample_rate, fps),), {"sample_rate": sample_rate, "encoding": PCM_S16}
    return {"dtype": "int16", "shape": shape, "names": None, "info": info}


def audio_keys(features: Iterable[str]) -> list[str]:
    """The keys of all microphones among a dataset's or a policy's features, in their order."""
    return [key for key in features if key.startswith(AUDIO_PREFIX)]


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Whether the pictures of a feature are distances."""
    info = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def check_audio_features(features: Features, fps: float) -> dict[str, int]:
    """Check every microphone of a dataset against the contract.

    Args:
        features: The dataset's features (`dataset.meta.features`).
        fps: The dataset's frames per second [Hz].

    Returns:
        The sample rate [Hz] of every audio key.

    Raises:
        ValueError: Naming the key, the value seen, the value wanted, and what to do.
    """
    return {key: _check_one(key, features[key], fps) for key in audio_keys(features)}


def _check_one(key: str, feature: Mapping[str, Any], fps: float) -> int:
    if feature["dtype"] == AUDIO_DTYPE:
        raise ValueError(
            f"'{key}' has its sound in files (dtype 'audio'); wanted a column. Make one: playbyear-attach-audio, "
            "without --files and --session."
        )
    if feature["dtype"] not in ("int16", "float32", "float64"):
        raise ValueError(
            f"'{key}' has dtype {feature['dtype']!r}; wanted 'int16' (PCM) or 'float32' (in [-1, 1]). Convert the column."
        )
    sample_rate = (feature.get("info") or {}).get("sample_rate")
    if sample_rate is None:
        raise ValueError(
            f'\'{key}\' does not say its sample rate: add "info": {{"sample_rate": <Hz>, "encoding": "{PCM_S16}"}} '
            "to this feature in the dataset's meta/info.json."
        )
    if isinstance(sample_rate, bool) or not isinstance(sample_rate, int | float) or sample_rate % 1 != 0:
        raise ValueError(f"'{key}' has sample_rate {sample_rate!r}; wanted a whole number of Hz, such as 16000.")
    if int(sample_rate) > _MOST_SAMPLES_PER_S:
        raise ValueError(
            f"'{key}' says that its sample rate is {sample_rate} Hz; wanted at most {_MOST_SAMPLES_PER_S} Hz. Correct it, "
            "and fps, in the dataset's meta/info.json."
        )
    wanted = (samples_per_frame(int(sample_rate), fps, key),)
    if tuple(feature["shape"]) != wanted:
        raise ValueError(
            f"'{key}' has shape {tuple(feature['shape'])}; at {sample_rate} Hz and {fps} frames per second it must be "
            f"{wanted}. Correct the sample rate in meta/info.json, or record again."
        )
    return int(sample_rate)


def arrow_schema(features: Features) -> pa.Schema:
    """The columns of a dataset's data files, as LeRobot makes them. Raises whatever LeRobot does of a feature that it lacks."""
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    shaped = {key: {**feature, "shape": tuple(feature["shape"])} for key, feature in features.items()}
    return get_hf_features_from_features(shaped).arrow_schema


def episode_waveform(dataset: "LeRobotDataset", episode: int, key: str) -> tuple[np.ndarray, int]:
    """The sound of a whole episode as one microphone heard it.

    Args:
        dataset: An opened dataset that holds the episode.
        episode: The episode's index in the dataset.
        key: The audio key.

    Returns:
        The samples, (n_frames * S,) in the column's dtype, and the sample rate [Hz].

    Raises:
        ValueError: If the key or the episode is not there, or the feature breaks the contract.
    """
    if key not in dataset.meta.features:
        raise ValueError(f"The dataset has no '{key}'; its audio keys are {audio_keys(dataset.meta.features)}.")
    sample_rate = _check_one(key, dataset.meta.features[key], dataset.fps)
    table = dataset.hf_dataset.data
    rows = np.flatnonzero(column_to_numpy(table.column("episode_index")) == episode)
    if len(rows) == 0:
        raise ValueError(f"The opened dataset has no episode {episode}; it has {dataset.num_episodes} episodes.")
    column = table.column(key).slice(int(rows[0]), len(rows))
    return column_to_numpy(column).reshape(-1), sample_rate


def to_pcm_s16(waveform: np.ndarray) -> np.ndarray:
    """Samples as int16 PCM: floats in [-1, 1] are scaled and clipped, int16 passes through.

    Raises:
        ValueError: If a sample is not finite, or the dtype is another integer.
    """
    waveform = np.asarray(waveform)
    if waveform.dtype == np.int16:
        return waveform
    if not np.issubdtype(waveform.dtype, np.floating):
        raise ValueError(f"Sound has dtype {waveform.dtype}; wanted int16 (PCM) or floats in [-1, 1].")
    if not np.isfinite(waveform).all():
        raise ValueError("Sound holds NaN or infinite samples; wanted floats in [-1, 1].")
    scaled = np.round(waveform.astype(np.float64) * _PCM_S16_FULL_SCALE)
    return np.clip(scaled, -_PCM_S16_FULL_SCALE, _PCM_S16_FULL_SCALE - 1).astype(np.int16)


def differences(
    there: Features, here: Features, keys: Iterable[str] | None = None, pictures_as_stored: bool = True
) -> list[str]:
    """In what the features of two datasets, or of a dataset and what would be written, differ.

    Args:
        there: The features of one.
        here: Those of the other.
        keys: Which to compare; None: all but those that LeRobot adds itself.
        pictures_as_stored: Whether pictures that are stored one by one differ from a video.

    Returns:
        A phrase for each difference in type, shape or sample rate, and in the names of numbers where both have them, such
        as "action is float32 (7,) there and absent here".
    """
    if keys is None:
        from lerobot.utils.constants import DEFAULT_FEATURES

        keys = sorted((there.keys() | here.keys()) - DEFAULT_FEATURES.keys())
    found = []
    for key in keys:
        old, new = (_describe(features.get(key), pictures_as_stored) for features in (there, here))
        old_names, new_names = (number_names(features.get(key)) for features in (there, here))
        if old != new:
            found.append(f"{key} is {old} there and {new} here")
        elif old_names and new_names and old_names != new_names:
            found.append(f"the numbers of {key} are {', '.join(old_names)} there and {', '.join(new_names)} here")
    return found


def _describe(feature: Mapping[str, Any] | None, pictures_as_stored: bool) -> str:
    if feature is None:
        return "absent"
    kind = "picture" if feature["dtype"] in ("image", "video") and not pictures_as_stored else feature["dtype"]
    rate = (feature.get("info") or {}).get("sample_rate")
    return f"{kind} {tuple(feature['shape'])}" + (f" at {rate} Hz" if rate else "")


def number_names(feature: Mapping[str, Any] | None) -> list[str] | None:
    """What the numbers of a vector are called, one name for each; None where they have none. Axes of pictures are none."""
    names = None if feature is None or len(feature["shape"]) != 1 else feature.get("names")
    while isinstance(names, Mapping) and len(names) == 1:  # LeRobot also writes {"motors": [...]}
        names = next(iter(names.values()))
    names = [str(name) for name in names] if isinstance(names, list | tuple | Mapping) else []
    return names if feature is not None and len(names) == feature["shape"][0] else None


def check_features(features: Features, fps: float) -> None:
    """Whether a dataset of these features can be written.

    Args:
        features: LeRobot features, without the ones LeRobot adds itself.
        fps: Frames per second.

    Raises:
        ValueError: Naming the key, the value seen and the value wanted.
    """
    if not isinstance(fps, int) or isinstance(fps, bool) or fps < 1:
        raise InputError(f"fps={fps!r}: wanted a whole number of frames per second, 1 or more.")
    for key, feature in features.items():
        _check_shape(key, feature)
        if not key.startswith(AUDIO_PREFIX):
            _check_type(key, feature)
    for key in check_audio_features(features, fps):
        rate = features[key]["info"]["sample_rate"]
        if not isinstance(rate, int):  # a reader takes any number that is whole; what is written is plain
            raise InputError(f"'{key}' has sample_rate {rate!r}; wanted whole Hz, a Python int such as 16000.")


def check_frame(frame: Mapping[str, Any], features: Features) -> None:
    """Whether a frame can become part of an episode.

    Args:
        frame: A numpy array of its dtype and shape per feature, and `task`.
        features: All features of the dataset.

    Raises:
        InputError: Naming the key, the value seen and the value wanted.
    """
    from lerobot.datasets.feature_utils import validate_frame

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
    if "/" in key:
        raise InputError(f"'{key}' has a '/' in it; LeRobot's names have none, such as {key.replace('/', '.')!r}.")
    if not all(isinstance(size, int | np.integer) and size > 0 for size in sizes):
        raise InputError(f"'{key}' has shape {shape!r}; wanted a tuple of positive whole numbers.")
    if key.startswith(AUDIO_PREFIX) and len(shape) > 1:
        advice = f"wanted ({max(shape)},)"
        if (n_channels := min(shape)) > 1:
            advice = f"every microphone is its own key: write {n_channels} features of shape ({max(shape)},), such as "
            advice += f"'{key}_left' and '{key}_right'"
        raise InputError(f"'{key}' has shape {tuple(shape)}; {advice}.")


def _check_type(key: str, feature: Mapping[str, Any]) -> None:
    """Whether LeRobot's files can hold a feature that is no sound."""
    try:
        arrow_schema({key: feature})
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"'{key}' has dtype {feature['dtype']!r} and shape {feature['shape']!r}, which no dataset can hold: {error}"
        ) from error
