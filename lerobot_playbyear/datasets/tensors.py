"""The columns of a LeRobotDataset as arrays, a piece at a time and in order.

LeRobot reads row by row, and every row passes through Python lists. Here a parquet column becomes numpy arrays
through Arrow, an image column is decoded by a few threads, and a video is decoded from its first frame to its last.
Whoever takes the pieces decides where they are kept; only a bounded piece is in memory at a time.
"""

import itertools
import math
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.datasets.info import file_inside
from lerobot_playbyear.datasets.long_dataset import LongDataset
from lerobot_playbyear.datasets.parquet import column_to_numpy, episode_bounds
from lerobot_playbyear.datasets.pictures import open_picture, video_pictures

_PICTURES_AT_ONCE = 32
_ROWS_AT_ONCE = 128  # images
_VALUES_AT_ONCE = 2**22
_PICTURE_BYTES = 2**25  # decoded at once, whatever their size


def value_pieces(dataset: LeRobotDataset | LongDataset, key: str, first: int = 0) -> Iterator[np.ndarray]:
    """A numeric column from row `first` on, in pieces (n,) or (n, *shape).

    Floats come as float32, integers and booleans as they are stored.

    Raises:
        ValueError: If rows are missing, differ from the feature's shape, or hold NaN or infinite values, those before
            `first` included.
    """
    column = dataset.hf_dataset.data.column(key)
    finite = np.ones(len(column), bool)
    finite[:first] = finite_rows(dataset, key, first)
    for position, read in _parts(dataset, key, first, len(column)):
        if np.issubdtype(read.dtype, np.floating):
            read = read.astype(np.float32, copy=False)
            finite[position : position + len(read)] = np.isfinite(read.reshape(len(read), -1)).all(axis=1)
        yield read
    check_finite(finite, key, column_to_numpy(dataset.hf_dataset.data.column("episode_index")))


def read_rows(dataset: LeRobotDataset | LongDataset, key: str, first: int, n: int) -> np.ndarray:
    """At most n rows of a numeric column from row `first` on, (n,) or (n, *shape), as they are stored.

    Raises:
        ValueError: If rows are missing, or differ from the feature's shape.
    """
    shape, column = _row_shape(dataset, key), dataset.hf_dataset.data.column(key)
    part = column.slice(first, n)
    try:
        return column_to_numpy(part).reshape(len(part), *shape)
    except ValueError as error:
        raise ValueError(
            f"'{key}' of dataset '{dataset.repo_id}' cannot be read as {len(column)} rows of shape {shape}: {error}. "
            "Record the damaged episodes again, or leave them out with --dataset.episodes."
        ) from error


def finite_rows(dataset: LeRobotDataset | LongDataset, key: str, n: int) -> np.ndarray:
    """Of each of the first n rows of a numeric column whether all its values are finite as float32, (n,) bool.

    Raises:
        ValueError: As `read_rows`.
    """
    finite = np.ones(n, bool)
    for position, read in _parts(dataset, key, 0, n):
        if not np.issubdtype(read.dtype, np.floating):
            break
        values = read.astype(np.float32, copy=False).reshape(len(read), -1)
        finite[position : position + len(read)] = np.isfinite(values).all(axis=1)
    return finite


def _parts(dataset: LeRobotDataset | LongDataset, key: str, first: int, stop: int) -> Iterator[tuple[int, np.ndarray]]:
    """The rows of a numeric column as `read_rows` gives them, in parts of bounded size, each with its first row."""
    rows = max(_VALUES_AT_ONCE // max(math.prod(_row_shape(dataset, key)), 1), 1)
    for position in range(first, stop, rows):
        yield position, read_rows(dataset, key, position, min(rows, stop - position))


def _row_shape(dataset: LeRobotDataset | LongDataset, key: str) -> tuple[int, ...]:
    shape = tuple(dataset.meta.features[key]["shape"])
    return () if shape == (1,) else shape  # LeRobot keeps one value per row as a scalar


def check_finite(finite: np.ndarray, key: str, episode_index: np.ndarray) -> None:
    """Refuse NaN and infinite values, naming the episodes that hold them.

    Args:
        finite: (N,) whether all values of a row are finite.
        key: The feature, for the message.
        episode_index: (N,) the episode of each row, for the message.

    Raises:
        ValueError: If a value is not finite.
    """
    if not finite.all():
        episodes = np.unique(episode_index[~finite]).tolist()
        raise ValueError(
            f"'{key}' holds NaN or infinite values in {int((~finite).sum())} of {len(finite)} frames (episodes "
            f"{episodes[:10]}{'...' if len(episodes) > 10 else ''}); wanted finite numbers. Record these episodes "
            "again, or leave them out with --dataset.episodes."
        )


def image_pieces(dataset: LeRobotDataset | LongDataset, key: str, first: int = 0) -> Iterator[np.ndarray]:
    """The frames of an image column from row `first` on, in pieces (n, C, H, W) uint8.

    Raises:
        ValueError: If a frame has another size than the one before, is empty, or lies outside the dataset's folder.
    """
    column = dataset.hf_dataset.data.column(key).slice(first)
    root, feature = Path(dataset.root), dataset.meta.features[key]
    mode = "L" if 1 in _channel_candidates(feature) else "RGB"
    position, size = first, None
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for rows in _few_rows(column, _at_once(feature, _ROWS_AT_ONCE)):
            images = list(pool.map(lambda row: _decode_image(row, root, key, feature, mode), rows.to_pylist()))
            size = size or images[0].shape
            for image in images:
                if image.shape != size:
                    raise ValueError(
                        f"'{key}': frame {position} is {image.shape}, the first one {size} (C, H, W). "
                        "All frames must have one size: record again, or resize the column."
                    )
                position += 1
            yield np.stack(images)


def video_pieces(
    dataset: LeRobotDataset | LongDataset, key: str, first: int = 0, video_backend: str | None = None
) -> Iterator[np.ndarray]:
    """The frames of a video feature from row `first` on, in pieces (n, C, H, W) uint8, episode by episode.

    Args:
        dataset: The dataset.
        key: The camera.
        first: The row to begin with.
        video_backend: LeRobot's decoder ("pyav", "torchcodec"); None takes its default.

    Raises:
        ValueError: If a video's pictures have another size than the feature says, or it lies outside the dataset's folder.
    """
    shape = dataset.meta.features[key]["shape"]
    n_at_once = _at_once(dataset.meta.features[key], _PICTURES_AT_ONCE)
    episode_index = column_to_numpy(dataset.hf_dataset.data.column("episode_index"))
    timestamps = column_to_numpy(dataset.hf_dataset.data.column("timestamp"))
    for start, end in zip(*episode_bounds(episode_index), strict=True):
        if end <= first:
            continue
        episode = int(episode_index[start])
        path = file_inside(Path(dataset.root), dataset.meta.get_video_file_path(episode, key))
        offset = dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
        times = [offset + float(timestamp) for timestamp in timestamps[max(start, first) : end]]
        pictures = video_pictures(path, times, dataset.tolerance_s, key, shape)
        while piece := list(itertools.islice(pictures, n_at_once)):
            yield np.stack(piece).transpose(0, 3, 1, 2)


def _at_once(feature: Mapping[str, Any], most: int) -> int:
    """How many pictures of a camera are decoded together; none is larger than its feature says."""
    return max(min(_PICTURE_BYTES // max(math.prod(feature["shape"]), 1), most), 1)


def _few_rows(column: pa.ChunkedArray, n: int) -> Iterator[pa.StructArray]:
    """The column in parts: what is decoded ahead of being stored would otherwise be the whole column once more."""
    for chunk in column.chunks:
        yield from (chunk.slice(first, n) for first in range(0, len(chunk), n))


def _decode_image(row: Mapping[str, Any], root: Path, key: str, feature: Mapping[str, Any], mode: str) -> np.ndarray:
    with open_picture(row, root, key, feature) as image:
        pixels = np.asarray(image.convert(mode))
    return pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1)  # (C, H, W)


def _channel_candidates(feature: dict[str, Any]) -> tuple[int, int]:
    shape = tuple(feature["shape"])
    return shape[0], shape[-1]  # declared (C, H, W) or (H, W, C)
