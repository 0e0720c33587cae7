"""A whole LeRobotDataset as one tensor per feature: in memory, or in files that are mapped into it."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.language import LANGUAGE_COLUMNS
from torch import Tensor
from tqdm import tqdm

from lerobot_playbyear.audio.audio_files import resample
from lerobot_playbyear.datasets.features import IS_FIRST, check_audio_features, samples_per_frame, to_pcm_s16
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.parquet import episode_bounds
from lerobot_playbyear.datasets.pictures import kept_shape, shrink
from lerobot_playbyear.datasets.reader import DatasetReader, check_finite
from lerobot_playbyear.training.frame_cache import cached_columns, dataset_identity

INDEX_KEYS = ("index", "episode_index", "frame_index", "task_index", "timestamp")
"""The columns that every LeRobotDataset has."""

PLACES = ("memory", "disk", "auto")
"""Where a dataset's frames are kept."""

_CAMERA_DTYPES = ("image", "video")
_GPU_SHARE = 0.5  # of the free memory: the network and its gradients need the rest
_MEMORY_SHARE = 0.5  # of what is free; what is on the disk is as fast as memory where it fits into it
_PCM_S16_FULL_SCALE = 32768
_PICTURES_AT_ONCE = 32
_EDGE = 128  # samples of the lower rate: twice what the resampler's filter reaches


def read_columns(
    reader: DatasetReader,
    keys: Iterable[str] | None = None,
    device: str | torch.device | None = None,
    progress: bool = False,
    place: str = "memory",
    image_size: int | None = None,
    cache: Path | None = None,
    sample_rates: Mapping[str, int] | None = None,
) -> tuple[dict[str, Tensor], list[int], list[int]]:
    """Read the episodes of a reader; arguments and errors as for `EpisodeStore.from_dataset`.

    Returns:
        Each feature as a tensor of N rows, the first frame of each episode, and the frame after its last. A part of an
        episode after a pause (`is_first`) is an episode of its own.
    """
    if len(reader) == 0:
        raise ValueError(f"The dataset '{reader.repo_id}' is empty: it has no frames. Record at least one episode.")
    features = _select_features(reader, keys)
    with_rate = {key: feature for key, feature in features.items() if sample_rate_in(feature) is not None}
    check_audio_features(with_rate, reader.fps)
    kept = features_at(features, sample_rates or {}, reader.fps)
    new_rates = {key: kept[key]["info"]["sample_rate"] for key in features if kept[key] is not features[key]}
    row_bytes = {key: _row_bytes(feature, image_size) for key, feature in kept.items()}
    n_bytes = sum(row_bytes.values()) * len(reader)
    device = _choose_device(device, n_bytes)
    n_cameras = sum(feature["dtype"] in _CAMERA_DTYPES for feature in features.values())
    bar = tqdm(
        desc="Reading frames",
        total=n_cameras * len(reader),
        unit="frame",
        delay=1,  # what is there already takes less
        disable=not (progress and n_cameras),
    )
    with bar:
        pieces = partial(_pieces, reader, image_size, new_rates, bar)
        if place == "disk":
            identity = {
                **dataset_identity(reader, features),
                "image_size": image_size,
                "sample_rates": new_rates,
            }
            on_disk = cached_columns(identity, row_bytes, len(reader), pieces, cache)
            columns = {key: values.to(device) for key, values in on_disk.items()}
        else:
            _check_memory(n_bytes, device)
            # One by one, so that a copy on another device never doubles the whole dataset.
            columns = {key: _gathered(pieces(key), len(reader)).to(device) for key in features}
    return columns, *_episodes(columns, reader.repo_id)


def choose_place(
    place: str,
    reader: DatasetReader,
    keys: Iterable[str] | None = None,
    sample_rates: Mapping[str, int] | None = None,
) -> str:
    """Where to keep a dataset: "memory" or "disk". "auto" is memory where its frames fill at most half of what is free.

    Raises:
        ValueError: There is no such place.
    """
    if place not in PLACES:
        raise ValueError(f"--store={place} is not known: wanted one of {', '.join(PLACES)}.")
    if place != "auto":
        return place
    kept = features_at(_select_features(reader, keys), sample_rates or {}, reader.fps)
    n_bytes = sum(map(_row_bytes, kept.values())) * len(reader)
    return "memory" if n_bytes <= _MEMORY_SHARE * available_memory() else "disk"


def features_at(features: Mapping[str, Any], sample_rates: Mapping[str, int], fps: int) -> dict[str, Any]:
    """A dataset's features, its microphones at other sample rates.

    Args:
        features: Of the dataset.
        sample_rates: By microphone [Hz]; what is not named, or has that rate, stays as it is.
        fps: The dataset's frames per second [Hz].

    Raises:
        ValueError: If the frame rate does not divide a sample rate.
    """
    changed = {}
    for key, rate in sample_rates.items():
        if key in features and sample_rate_in(features[key]) not in (None, rate):
            info = {**features[key]["info"], "sample_rate": rate}
            changed[key] = {**features[key], "shape": (samples_per_frame(rate, fps, key),), "info": info}
    return {**features, **changed}


def sample_rate_in(feature: Mapping[str, Any]) -> int | None:
    """What a feature says of its sample rate [Hz]; None: nothing."""
    return (feature.get("info") or {}).get("sample_rate")


def _pieces(
    reader: DatasetReader, image_size: int | None, sample_rates: Mapping[str, int], bar: tqdm, key: str
) -> Iterator[np.ndarray]:
    """A column in pieces (n, ...), pictures and sound at the size and the rate at which they are kept.

    Raises:
        ValueError: A value is NaN or infinite.
    """
    if reader.features[key]["dtype"] in _CAMERA_DTYPES:
        for episode in reader.episodes:
            pictures = reader.pictures(key, episode)
            while piece := list(itertools.islice(pictures, _PICTURES_AT_ONCE)):
                stacked = np.stack(piece).transpose(0, 3, 1, 2)  # (n, C, H, W)
                yield stacked if image_size is None else shrink(stacked, image_size)
                bar.update(len(piece))
        return
    if reader.features[key]["dtype"].startswith("float"):
        check_finite(reader, key)
    for episode in reader.episodes:
        values = reader.values(key, episode)
        if key in sample_rates:
            values = _resampled(reader, key, values, sample_rates[key])
        yield values.astype(np.float32, copy=False) if np.issubdtype(values.dtype, np.floating) else values


def _resampled(reader: DatasetReader, key: str, rows: np.ndarray, sample_rate: int) -> np.ndarray:
    """An episode's sound (n, S) at another sample rate, in the stored form.

    What was heard before its first sample and after its last is not known: there the sound goes on as its mirror image, turned
    about that sample, so that its edges do not ring.
    """
    n_samples, is_pcm = samples_per_frame(sample_rate, reader.fps, key), rows.dtype == np.int16
    n_edge = math.ceil(_EDGE / min(n_samples, rows.shape[1]))  # frames
    sound = rows.reshape(-1).astype(np.float32) / (_PCM_S16_FULL_SCALE if is_pcm else 1)
    padded = np.pad(sound, n_edge * rows.shape[1], mode="reflect", reflect_type="odd")
    old_rate = int(reader.features[key]["info"]["sample_rate"])
    new = resample(padded, old_rate, sample_rate).reshape(-1, n_samples)[n_edge : n_edge + len(rows)]
    return to_pcm_s16(new) if is_pcm else new


def _gathered(pieces: Iterator[np.ndarray], n_rows: int) -> Tensor:
    """All pieces of a column as one tensor, (N, ...)."""
    values: np.ndarray | None = None
    position = 0
    for piece in pieces:
        if values is None:
            values = np.empty((n_rows, *piece.shape[1:]), piece.dtype)
        values[position : position + len(piece)] = piece
        position += len(piece)
    assert values is not None
    assert position == n_rows
    return torch.from_numpy(values)


def _select_features(reader: DatasetReader, keys: Iterable[str] | None) -> dict[str, Any]:
    features = reader.features
    if keys is None:
        keys = [
            key
            for key, feature in features.items()
            if key not in LANGUAGE_COLUMNS and key not in reader.meta.depth_keys and feature["dtype"] != "string"
        ]
    keys = list(dict.fromkeys([*keys, *INDEX_KEYS, *([IS_FIRST] if _has_is_first(features) else [])]))
    for key in keys:
        if key not in features:
            raise ValueError(f"The dataset '{reader.repo_id}' has no '{key}'; it has {sorted(features)}.")
        if key in reader.meta.depth_keys or features[key]["dtype"] == "string" or key in LANGUAGE_COLUMNS:
            raise ValueError(f"'{key}' ({features[key]['dtype']}) cannot be kept in memory: use lerobot-train for it.")
    return {key: features[key] for key in keys}


def _has_is_first(features: Mapping[str, Any]) -> bool:
    """Whether the dataset has that column, and no other one of that name."""
    feature = features.get(IS_FIRST)
    return feature is not None and feature["dtype"] == "bool" and math.prod(feature["shape"]) == 1


def _row_bytes(feature: Mapping[str, Any], image_size: int | None = None) -> int:
    """Of a camera kept at `image_size`, at most."""
    dtype, shape = feature["dtype"], tuple(feature["shape"])
    if dtype in _CAMERA_DTYPES:
        return math.prod(kept_shape(shape, image_size))
    return math.prod(shape) * (4 if dtype.startswith("float") else np.dtype(dtype).itemsize)


def _choose_device(device: str | torch.device | None, n_bytes: int) -> torch.device:
    if device is None:
        fits = torch.cuda.is_available() and n_bytes <= _GPU_SHARE * torch.cuda.mem_get_info()[0]
        device = "cuda" if fits else "cpu"
    return torch.device(device)


def _check_memory(n_bytes: int, device: torch.device) -> None:
    free = available_memory()
    if device.type == "cpu" and n_bytes > free:
        raise MemoryError(
            f"The dataset needs {n_bytes / 2**30:.1f} GiB in memory, and {free / 2**30:.1f} GiB are free. Keep it on the "
            "disk (--store=disk), choose fewer episodes (--dataset.episodes), or end other programs."
        )


def _episodes(columns: Mapping[str, Tensor], repo_id: str) -> tuple[list[int], list[int]]:
    starts, ends = episode_bounds(columns["episode_index"].cpu().numpy())
    frame_index = columns["frame_index"].cpu()
    for start, end in zip(starts, ends, strict=True):
        if not torch.equal(frame_index[start:end], torch.arange(end - start)):
            raise ValueError(
                f"Episode {int(columns['episode_index'][start])} of '{repo_id}' is incomplete: its {end - start} rows "
                f"are not frames 0 to {end - start - 1}. Remove it with lerobot-edit-dataset, or record it again."
            )
    if IS_FIRST in columns and columns[IS_FIRST].dtype == torch.bool:
        # LeRobot's rollout resets the policy after a pause: no window reaches back beyond it.
        starts = sorted({*starts, *columns[IS_FIRST].reshape(-1).cpu().nonzero().reshape(-1).tolist()})
        ends = [*starts[1:], *ends[-1:]]
    return starts, ends
