"""Statistics in a repaired dataset: of an episode whose row is made anew, and those of `meta/stats.json`.

An episode has them as LeRobot makes them while recording. Of `meta/stats.json` what is right stays as it is, and what is
made anew is named.
"""

import contextlib
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import auto_downsample_height_width, sample_indices
from lerobot.datasets.io_utils import cast_stats_to_numpy
from lerobot.datasets.utils import STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.confines import open_picture
from lerobot_playbyear.datasets.features import audio_keys
from lerobot_playbyear.datasets.files import read_listed
from lerobot_playbyear.datasets.info import file_inside
from lerobot_playbyear.datasets.parquet import column_to_numpy
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.report import RepairReport
from lerobot_playbyear.datasets.repair.videos import TOLERANCE, video_file
from lerobot_playbyear.datasets.statistics import (
    Stats,
    add_stats,
    channel_stats,
    numeric_stats,
    repeated_stats,
    row_stats,
)
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


_TOLERANCE = 0.01  # between statistics that were added up episode by episode and all at once


def read_own_stats(
    report: RepairReport, features: Mapping[str, Any], is_begun: bool
) -> dict[str, dict[str, np.ndarray] | None] | None:
    """Reads `meta/stats.json`.

    Args:
        report: Of the dataset; what is wrong is added.
        features: The dataset's.
        is_begun: Whether it has only been begun, and may have no statistics yet.

    Returns:
        Its entry for each feature, or None for a wrong one; None where the file is lost.

    Raises:
        OSError: It cannot be read now.
    """
    data = read_listed(report.root, STATS_PATH)
    if data is None:
        report.findings += [] if is_begun else [f"{STATS_PATH} is missing"]
        return None
    try:
        stats = cast_stats_to_numpy(json.loads(data))
        entries = {key: own if _are_numbers(own) else None for key, own in stats.items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        report.findings.append(f"{STATS_PATH} cannot be read: {error}")
        return None
    report.findings += [
        f"{STATS_PATH}: the entries of '{key}' are no numbers of shape {tuple(features.get(key, {}).get('shape', ()))}"
        for key, own in entries.items()
        if own is None
    ]
    return entries


def _are_numbers(own: Any) -> bool:
    return isinstance(own, dict) and all(value.dtype.kind in "fiub" for value in own.values())


def settle_stats(
    own: Mapping[str, dict[str, np.ndarray] | None] | None,
    info: DatasetInfo,
    rows: Sequence[Row],
    rows_before: Sequence[Row],
) -> tuple[Stats | None, list[str]]:
    """The statistics of the repaired dataset.

    An entry that describes as many frames as there still are stays. Of the others, values that were never those of
    the episodes, set by hand, stay too; the rest is added up anew.

    Args:
        own: The dataset's, as `read_own_stats` has them.
        info: What it says about itself.
        rows: The rows of the kept episodes, with their statistics.
        rows_before: All rows that there were.

    Returns:
        The statistics, or None if the file can stay as it is; and what is other than it was.
    """
    microphones = audio_keys(info.features)
    made = add_stats(None, [row_stats(row) for row in rows], microphones)
    if own is None:
        return made, [f"{STATS_PATH}: made anew from the episodes; what it held that is not theirs is lost"]
    before: Stats = {}
    with contextlib.suppress(ValueError, TypeError, AttributeError, KeyError):  # of rows that may be damaged
        before = add_stats(None, [row_stats(row) for row in rows_before], microphones)
    settled: Stats = dict(made)
    anew: list[str] = []
    by_hand: list[str] = []
    for key, entry in own.items():
        if entry is None:
            continue
        if key not in made or _alike(entry.get("count"), made[key].get("count")):
            settled[key] = entry
            by_hand += [] if key in info.features else [f"'{key}'"]
            continue
        set_by_hand = _set_by_hand(entry, before.get(key, {}))
        kept = {name: value for name, value in entry.items() if name in set_by_hand or name not in made[key]}
        settled[key] = {**made[key], **kept}
        by_hand += [f"{name} of '{key}'" for name in kept]
        anew.append(key)
    anew += [key for key in made if own.get(key) is None]
    notes = []
    if anew:
        notes.append(f"{STATS_PATH}: made anew from the episodes: {', '.join(sorted(anew))}")
        if by_hand:
            notes.append(f"{STATS_PATH}: not those of the episodes, and as they were: {', '.join(by_hand)}")
    return (settled if anew or None in own.values() else None), notes


def _set_by_hand(own: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]) -> set[str]:
    """Which statistics differ from those that the episodes add up to."""
    if not _alike(own.get("count"), before.get("count")):
        return set()  # they are older than the last episodes: nothing can be said
    return {name for name, value in own.items() if name in before and not _alike(value, before[name])}


def _alike(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    if one is None or other is None or one.shape != other.shape:
        return one is other
    one, other = one.astype(float), other.astype(float)
    return np.allclose(
        one, other, rtol=_TOLERANCE, atol=1e-6 * max(1.0, float(np.abs(other).max(initial=0))), equal_nan=True
    )
