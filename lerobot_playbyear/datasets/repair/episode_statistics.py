"""Statistics of an episode that is on disk already, for a row that is made anew; LeRobot makes them while recording."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import auto_downsample_height_width, sample_indices
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.confines import file_inside, open_picture
from lerobot_playbyear.datasets.repair.camera import TOLERANCE, video_file
from lerobot_playbyear.datasets.repair.episode_tables import Row
from lerobot_playbyear.datasets.statistics import Stats, channel_stats, numeric_stats, repeated_stats
from lerobot_playbyear.datasets.video_pictures import video_pictures

Frames = Callable[[], Iterable[pa.Table]]
"""Gives an episode's frames in parts, from the first whenever it is called."""

_PICTURES_AT_ONCE = 128


def episode_stats(root: Path, info: DatasetInfo, row: Row, frames: Frames, length: int) -> Stats:
    """The statistics of one episode, as LeRobot has them: of pictures, from as many as it samples.

    Args:
        root: The dataset's folder, for its videos, and pictures in files.
        info: What the dataset says about itself.
        row: Where the episode's videos are.
        frames: Its frames.
        length: How many.

    Raises:
        ValueError: A picture or a video lies outside the folder, or a picture has another size than the feature says.
    """
    numbers: dict[str, np.ndarray] = {}
    stats: Stats = {}
    for key, feature in info.features.items():
        shape = tuple(feature["shape"])
        if _is_depth(feature) or feature["dtype"] in ("string", "language"):
            continue
        if feature["dtype"] in ("image", "video"):
            pictures = (
                partial(_pictures, root, frames, key, feature, length)
                if feature["dtype"] == "image"
                else partial(_video_pictures, root, info, key, row, length)
            )
            stats[key] = channel_stats(partial(_downsampled, pictures), len(sample_indices(length)))
        elif key in audio_keys([key]):
            stats[key] = repeated_stats(partial(_rows, frames, key), length, math.prod(shape))
        else:
            values = np.concatenate(list(_rows(frames, key)))
            numbers[key] = values.reshape(length, *(() if shape == (1,) else shape))
    return {**numeric_stats(numbers, info.features), **stats}


def _rows(frames: Frames, key: str) -> Iterator[np.ndarray]:
    """A numeric column in parts, (n, D)."""
    for part in frames():
        yield column_to_numpy(part.column(key)).reshape(len(part), -1)


def _pictures(root: Path, frames: Frames, key: str, feature: dict, length: int) -> Iterator[np.ndarray]:
    """The pictures that LeRobot samples, (H, W, 3) uint8."""
    wanted, first = set(sample_indices(length)), 0
    for part in frames():
        column = part.column(key)
        for index in range(len(part)):
            if first + index in wanted:
                with open_picture(column[index].as_py(), root, key, feature) as image:
                    yield np.asarray(image.convert("RGB"))
        first += len(part)


def _video_pictures(root: Path, info: DatasetInfo, key: str, row: Row, length: int) -> Iterator[np.ndarray]:
    path = file_inside(root, video_file(info, key, row))
    times = [row[f"videos/{key}/from_timestamp"] + index / info.fps for index in sample_indices(length)]
    return video_pictures(path, times, TOLERANCE, "pyav")


def _downsampled(pictures: Callable[[], Iterable[np.ndarray]]) -> Iterator[np.ndarray]:
    """As small as LeRobot looks at them, some at a time, (n, C, h, w)."""
    small = (auto_downsample_height_width(picture.transpose(2, 0, 1)) for picture in pictures())
    for batch in itertools.batched(small, _PICTURES_AT_ONCE):
        yield np.stack(batch)


def _is_depth(feature: dict) -> bool:
    details = feature.get("info") or {}
    return bool(details.get("is_depth_map") or details.get("video.is_depth_map"))
