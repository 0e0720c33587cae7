"""Statistics of an episode that is on disk already, for a row that is made anew; LeRobot makes them while recording."""

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import auto_downsample_height_width, get_feature_stats, sample_indices
from lerobot.datasets.utils import DatasetInfo
from lerobot.datasets.video_utils import decode_video_frames
from PIL import Image

from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.statistics import Stats, numeric_stats

_TOLERANCE = 1e-4  # seconds, LeRobot's own


def episode_stats(root: Path, info: DatasetInfo, row: Row, frames: pa.Table) -> Stats:
    """The statistics of one episode, as LeRobot has them: of pictures, from as many as it samples.

    Args:
        root: The dataset's folder, for its videos.
        info: What the dataset says about itself.
        row: Where the episode's videos are.
        frames: Its frames.
    """
    numbers: dict[str, np.ndarray] = {}
    stats: Stats = {}
    for key, feature in info.features.items():
        if _is_depth(feature) or feature["dtype"] in ("string", "language"):
            continue
        if feature["dtype"] == "image":
            stats[key] = _picture_stats(_pictures(frames.column(key)))
        elif feature["dtype"] == "video":
            stats[key] = _picture_stats(_video_pictures(root, info, key, row, len(frames)))
        else:
            shape = tuple(feature["shape"])
            numbers[key] = column_to_numpy(frames.column(key)).reshape(len(frames), *(() if shape == (1,) else shape))
    return {**numeric_stats(numbers, info.features), **stats}


def _pictures(column: pa.ChunkedArray) -> list[np.ndarray]:
    pictures = []
    for index in sample_indices(len(column)):
        with Image.open(io.BytesIO(column[index].as_py()["bytes"])) as image:
            pictures.append(np.asarray(image.convert("RGB")).transpose(2, 0, 1))
    return pictures


def _video_pictures(root: Path, info: DatasetInfo, key: str, row: Row, length: int) -> list[np.ndarray]:
    path = root / str(info.video_path).format(
        video_key=key, chunk_index=row[f"videos/{key}/chunk_index"], file_index=row[f"videos/{key}/file_index"]
    )
    times = [row[f"videos/{key}/from_timestamp"] + index / info.fps for index in sample_indices(length)]
    return list(decode_video_frames(path, times, _TOLERANCE, "pyav", return_uint8=True).numpy())


def _picture_stats(pictures: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Per channel, of pictures (C, H, W) uint8 scaled to [0, 1]."""
    batch = np.stack([auto_downsample_height_width(picture) for picture in pictures])
    stats = get_feature_stats(batch, axis=(0, 2, 3), keepdims=True)
    return {name: value if name == "count" else np.squeeze(value / 255.0, axis=0) for name, value in stats.items()}


def _is_depth(feature: dict) -> bool:
    details = feature.get("info") or {}
    return bool(details.get("is_depth_map") or details.get("video.is_depth_map"))
