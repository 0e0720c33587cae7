"""The columns of a LeRobotDataset as whole tensors, read once and in order.

LeRobot reads row by row, and every row passes through Python lists. Here a parquet column becomes one numpy array
through Arrow, an image column is decoded by a few threads, and a video is decoded from its first frame to its last.
Besides the tensor that is asked for, only a bounded piece is in memory at a time.
"""

import math
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets import LeRobotDataset
from torch import Tensor

from lerobot_playbyear.datasets.columns import column_to_numpy, episode_bounds
from lerobot_playbyear.datasets.confines import file_inside, open_picture
from lerobot_playbyear.datasets.long_dataset import LongDataset
from lerobot_playbyear.datasets.video_pictures import video_pictures

_ROWS_AT_ONCE = 128  # images
_VALUES_AT_ONCE = 2**22
Progress = Callable[[str, int], Any]
"""Called with a key and the number of its frames that were just decoded."""


def read_values(dataset: LeRobotDataset | LongDataset, key: str) -> Tensor:
    """A numeric column, (N,) or (N, *shape): floats as float32, integers and booleans as they are stored.

    Raises:
        ValueError: If rows are missing, differ from the feature's shape, or hold NaN or infinite values.
    """
    shape = tuple(dataset.meta.features[key]["shape"])
    shape = () if shape == (1,) else shape  # LeRobot keeps one value per row as a scalar
    column = dataset.hf_dataset.data.column(key)
    rows = max(_VALUES_AT_ONCE // max(math.prod(shape), 1), 1)
    values: np.ndarray | None = None
    finite = np.ones(len(column), bool)
    for first in range(0, len(column), rows):
        part = column.slice(first, rows)
        try:
            read = column_to_numpy(part).reshape(len(part), *shape)
        except ValueError as error:
            raise ValueError(
                f"'{key}' of dataset '{dataset.repo_id}' cannot be read as {len(column)} rows of shape {shape}: {error}. "
                "Record the damaged episodes again, or leave them out with --dataset.episodes."
            ) from error
        is_float = np.issubdtype(read.dtype, np.floating)
        if values is None:
            values = np.empty((len(column), *shape), np.float32 if is_float else read.dtype)
        if is_float:
            finite[first : first + rows] = np.isfinite(read.reshape(len(read), -1)).all(axis=1)
        values[first : first + rows] = read
    if values is None:
        raise ValueError(f"'{key}' of dataset '{dataset.repo_id}' has no rows.")
    check_finite(finite, key, column_to_numpy(dataset.hf_dataset.data.column("episode_index")))
    return torch.from_numpy(values)


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


def read_images(dataset: LeRobotDataset | LongDataset, key: str, progress: Progress | None = None) -> Tensor:
    """All frames of an image column, (N, C, H, W) uint8.

    Raises:
        ValueError: If a frame has another size than the feature, is empty, or lies outside the dataset's folder.
    """
    column = dataset.hf_dataset.data.column(key)
    root, feature = Path(dataset.root), dataset.meta.features[key]
    mode = "L" if 1 in _channel_candidates(feature) else "RGB"
    frames: Tensor | None = None
    position = 0
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for rows in _few_rows(column):
            for image in pool.map(lambda row: _decode_image(row, root, key, feature, mode), rows.to_pylist()):
                if frames is None:
                    frames = torch.empty((len(column), *image.shape), dtype=torch.uint8)
                if image.shape != frames.shape[1:]:
                    raise ValueError(
                        f"'{key}': frame {position} is {image.shape}, the first one {tuple(frames.shape[1:])} (C, H, W). "
                        "All frames must have one size: record again, or resize the column."
                    )
                frames[position].numpy()[:] = image
                position += 1
                if progress:
                    progress(key, 1)
    if frames is None:
        raise ValueError(f"'{key}' of dataset '{dataset.repo_id}' has no frames.")
    return frames


def read_videos(
    dataset: LeRobotDataset | LongDataset,
    key: str,
    video_backend: str | None = None,
    progress: Progress | None = None,
) -> Tensor:
    """All frames of a video feature, (N, C, H, W) uint8, decoded episode by episode as LeRobot decodes them.

    Args:
        dataset: The dataset.
        key: The camera.
        video_backend: LeRobot's decoder ("pyav", "torchcodec"); None takes its default.
        progress: Told of every decoded episode.
    """
    episode_index = column_to_numpy(dataset.hf_dataset.data.column("episode_index"))
    timestamps = column_to_numpy(dataset.hf_dataset.data.column("timestamp"))
    frames: Tensor | None = None
    for start, end in zip(*episode_bounds(episode_index), strict=True):
        episode = int(episode_index[start])
        path = file_inside(Path(dataset.root), dataset.meta.get_video_file_path(episode, key))
        offset = dataset.meta.episodes[episode][f"videos/{key}/from_timestamp"]
        times = [offset + float(timestamp) for timestamp in timestamps[start:end]]
        for position, picture in enumerate(video_pictures(path, times, dataset.tolerance_s, video_backend), start):
            pixels = torch.from_numpy(picture).permute(2, 0, 1)  # (C, H, W)
            if frames is None:
                frames = torch.empty((len(episode_index), *pixels.shape), dtype=torch.uint8)
            frames[position] = pixels
        if progress:
            progress(key, end - start)
    if frames is None:
        raise ValueError(f"'{key}' of dataset '{dataset.repo_id}' has no frames.")
    return frames


def _few_rows(column: pa.ChunkedArray) -> Iterator[pa.StructArray]:
    """The column in parts: what is decoded ahead of being stored would otherwise be the whole column once more."""
    for chunk in column.chunks:
        yield from (chunk.slice(first, _ROWS_AT_ONCE) for first in range(0, len(chunk), _ROWS_AT_ONCE))


def _decode_image(row: Mapping[str, Any], root: Path, key: str, feature: Mapping[str, Any], mode: str) -> np.ndarray:
    with open_picture(row, root, key, feature) as image:
        pixels = np.asarray(image.convert(mode))
    return pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1)  # (C, H, W)


def _channel_candidates(feature: dict[str, Any]) -> tuple[int, int]:
    shape = tuple(feature["shape"])
    return shape[0], shape[-1]  # declared (C, H, W) or (H, W, C)
