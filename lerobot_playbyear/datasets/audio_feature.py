"""How a LeRobotDataset carries sound.

Every microphone is one column `observation.audio.<microphone>`: a row holds the samples heard since the previous
frame, so its length is `sample_rate / fps`, an integer. Integers are PCM at full scale, floats are already in
[-1, 1]; the sample rate stands in the feature's `info`. Nothing here needs the policy: a dataset of this shape is
a plain LeRobotDataset v3.0.
"""

import wave
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_playbyear.datasets.columns import column_to_numpy

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

AUDIO_PREFIX = "observation.audio."
"""What the key of every microphone starts with."""

AUDIO_DTYPE = "audio"
"""Of a feature whose sound lies in files beside the frames, which is not our layout: see `audio_layout`."""

IS_FIRST = "is_first"
"""A column of datasets with pauses: the frames before which something was not recorded, each episode's first one included.
Memory and sound do not reach back beyond such a frame."""

IS_FIRST_FEATURE = {"dtype": "bool", "shape": (1,), "names": None}

MICROPHONE = "microphone"
"""Where the `info` of a microphone's pictures names its sound, `observation.audio.<microphone>`."""

PCM_S16 = "pcm_s16"
_PCM_S16_FULL_SCALE = 32768
_DTYPES = ("int16", "float32", "float64")
_MOST_SAMPLES_PER_S = 1_000_000


def samples_per_frame(sample_rate: int, fps: int, key: str = AUDIO_PREFIX + "<microphone>") -> int:
    """The number of samples between two frames.

    Args:
        sample_rate: Samples per second [Hz].
        fps: Frames per second [Hz].
        key: The audio key, for the message.

    Raises:
        ValueError: If the frame rate does not divide the sample rate.
    """
    if sample_rate <= 0 or fps <= 0 or sample_rate % fps:
        nearest = max(1, round(sample_rate / fps)) * fps if fps > 0 else sample_rate
        raise ValueError(
            f"'{key}': a frame must hold a whole number of samples, but sample_rate / fps = {sample_rate} / {fps} "
            f"is not a positive integer. Choose a sample rate that is a multiple of {fps} Hz, for example "
            f"{nearest} Hz, and resample the recording to it."
        )
    return int(sample_rate // fps)


def audio_feature(sample_rate: int, fps: int) -> dict[str, Any]:
    """The feature of one microphone for `LeRobotDataset.create(features=...)`: int16 PCM of shape (S,).

    Args:
        sample_rate: Samples per second [Hz]; a multiple of `fps`.
        fps: Frames per second of the dataset [Hz].

    Raises:
        ValueError: If the frame rate does not divide the sample rate.
    """
    return {
        "dtype": "int16",
        "shape": (samples_per_frame(sample_rate, fps),),
        "names": None,
        "info": {"sample_rate": sample_rate, "encoding": PCM_S16},
    }


def audio_keys(features: Iterable[str]) -> list[str]:
    """The keys of all microphones among a dataset's or a policy's features, in their order."""
    return [key for key in features if key.startswith(AUDIO_PREFIX)]


def check_audio_features(features: Mapping[str, Mapping[str, Any]], fps: int) -> dict[str, int]:
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


def _check_one(key: str, feature: Mapping[str, Any], fps: int) -> int:
    if feature["dtype"] == AUDIO_DTYPE:
        raise ValueError(
            f"'{key}' has its sound in files (dtype 'audio'); wanted a column. Make one: playbyear-attach-audio, "
            "without --files and --session."
        )
    if feature["dtype"] not in _DTYPES:
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


def pcm_channels(waveform: np.ndarray) -> np.ndarray:
    """Sound (n,) or (n, channels) as (n, channels) int16 PCM. Raises as `to_pcm_s16`, also where the shape is another."""
    samples = to_pcm_s16(waveform)
    if samples.ndim not in (1, 2):
        raise ValueError(f"Sound has shape {samples.shape}; wanted (n,) or (n, channels).")
    return samples[:, None] if samples.ndim == 1 else samples


def write_wav(path: str | Path, waveform: np.ndarray, sample_rate: int) -> Path:
    """Write sound as a 16-bit WAV file.

    Args:
        path: The file to write; its folder is made.
        waveform: (n,) or (n, channels), int16 PCM or floats in [-1, 1].
        sample_rate: Samples per second [Hz].

    Returns:
        The path of the file.

    Raises:
        ValueError: If the samples are neither, or the shape is another.
    """
    samples = pcm_channels(waveform)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(samples.shape[1])
        file.setsampwidth(2)
        file.setframerate(sample_rate)
        file.writeframes(np.ascontiguousarray(samples).astype("<i2").tobytes())
    return path
