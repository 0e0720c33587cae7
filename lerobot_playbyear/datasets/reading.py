"""A whole LeRobotDataset as one tensor per feature: in memory, or in files that are mapped into it."""

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from lerobot.utils.import_utils import get_safe_default_video_backend
from torch import Tensor
from tqdm import tqdm

from lerobot_playbyear.datasets.disk_columns import DEFAULT_CACHE, disk_columns
from lerobot_playbyear.datasets.features import IS_FIRST, check_audio_features
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.identity import dataset_identity
from lerobot_playbyear.datasets.long_dataset import LongDataset
from lerobot_playbyear.datasets.parquet import episode_bounds
from lerobot_playbyear.datasets.pictures import kept_shape, shrink
from lerobot_playbyear.datasets.resampling import features_at, resampled_pieces
from lerobot_playbyear.datasets.tensors import image_pieces, value_pieces, video_pieces

INDEX_KEYS = ("index", "episode_index", "frame_index", "task_index", "timestamp")
"""The columns that every LeRobotDataset has."""

PLACES = ("memory", "disk", "auto")
"""Where a dataset's frames are kept."""

_CAMERA_DTYPES = ("image", "video")
_GPU_SHARE = 0.5  # of the free memory: the network and its gradients need the rest
_MEMORY_SHARE = 0.5  # of what is free; what is on the disk is as fast as memory where it fits into it


def read_dataset(
    dataset: LeRobotDataset | LongDataset,
    keys: Iterable[str] | None = None,
    device: str | torch.device | None = None,
    video_backend: str | None = None,
    progress: bool = False,
    place: str = "memory",
    image_size: int | None = None,
    cache: Path | None = None,
    sample_rates: Mapping[str, int] | None = None,
) -> tuple[dict[str, Tensor], list[int], list[int]]:
    """Read the episodes that a dataset was opened with; arguments and errors as for `EpisodeStore.from_dataset`.

    Returns:
        Each feature as a tensor of N rows, the first frame of each episode, and the frame after its last. A part of an
        episode after a pause (`is_first`) is an episode of its own.
    """
    if len(dataset) == 0:
        raise ValueError(f"The dataset '{dataset.repo_id}' is empty: it has no frames. Record at least one episode.")
    features = _select_features(dataset, keys)
    with_rate = {key: f for key, f in features.items() if "sample_rate" in (f.get("info") or {})}
    check_audio_features(with_rate, dataset.fps)
    kept = features_at(features, sample_rates or {}, dataset.fps)
    new_rates = {key: kept[key]["info"]["sample_rate"] for key in features if kept[key] is not features[key]}
    row_bytes = {key: _row_bytes(feature, image_size) for key, feature in kept.items()}
    n_bytes = sum(row_bytes.values()) * len(dataset)
    device = _choose_device(device, n_bytes)
    n_cameras = sum(feature["dtype"] in _CAMERA_DTYPES for feature in features.values())
    bar = tqdm(
        desc="Reading frames",
        total=n_cameras * len(dataset),
        unit="frame",
        delay=1,  # what is there already takes less
        disable=not (progress and n_cameras),
    )
    with bar:
        pieces = partial(_pieces, dataset, video_backend, image_size, new_rates, bar)
        if place == "disk":
            cache = cache or DEFAULT_CACHE
            identity = {
                **dataset_identity(dataset, features, cache),
                "image_size": image_size,
                "decoder": video_backend or get_safe_default_video_backend(),
                **({"sample_rates": new_rates} if new_rates else {}),
            }
            on_disk = disk_columns(identity, row_bytes, len(dataset), pieces, cache)
            columns = {key: values.to(device) for key, values in on_disk.items()}
        else:
            _check_memory(n_bytes, device)
            # One by one, so that a copy on another device never doubles the whole dataset.
            columns = {key: _gathered(pieces(key, 0), len(dataset)).to(device) for key in features}
    starts, ends = _episodes(columns, dataset.repo_id)
    return columns, starts, ends


def choose_place(
    place: str,
    dataset: LeRobotDataset | LongDataset,
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
    kept = features_at(_select_features(dataset, keys), sample_rates or {}, dataset.fps)
    n_bytes = sum(map(_row_bytes, kept.values())) * len(dataset)
    return "memory" if n_bytes <= _MEMORY_SHARE * available_memory() else "disk"


def _pieces(
    dataset: LeRobotDataset | LongDataset,
    video_backend: str | None,
    image_size: int | None,
    sample_rates: Mapping[str, int],
    bar: tqdm,
    key: str,
    first: int,
) -> Iterator[np.ndarray]:
    """A column from row `first` on, pictures and sound at the size and the rate at which they are kept."""
    dtype = dataset.meta.features[key]["dtype"]
    if key in sample_rates:
        yield from resampled_pieces(dataset, key, sample_rates[key], first)
        return
    if dtype not in _CAMERA_DTYPES:
        yield from value_pieces(dataset, key, first)
        return
    bar.update(first)  # made by an earlier run
    is_video = dtype == "video"
    for piece in video_pieces(dataset, key, first, video_backend) if is_video else image_pieces(dataset, key, first):
        yield piece if image_size is None else shrink(piece, image_size)
        bar.update(len(piece))


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


def _select_features(dataset: LeRobotDataset | LongDataset, keys: Iterable[str] | None) -> dict[str, Any]:
    features = dataset.meta.features
    if keys is None:
        keys = [
            key
            for key, feature in features.items()
            if key not in LANGUAGE_COLUMNS and key not in dataset.meta.depth_keys and feature["dtype"] != "string"
        ]
    keys = list(dict.fromkeys([*keys, *INDEX_KEYS, *([IS_FIRST] if _has_is_first(features) else [])]))
    for key in keys:
        if key not in features:
            raise ValueError(f"The dataset '{dataset.repo_id}' has no '{key}'; it has {sorted(features)}.")
        if key in dataset.meta.depth_keys or features[key]["dtype"] == "string" or key in LANGUAGE_COLUMNS:
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
    if (
        IS_FIRST in columns and columns[IS_FIRST].dtype == torch.bool
    ):  # LeRobot's rollout resets the policy after a pause: no window reaches back beyond it
        starts = sorted({*starts, *columns[IS_FIRST].reshape(-1).cpu().nonzero().reshape(-1).tolist()})
        ends = [*starts[1:], *ends[-1:]]
    return starts, ends
