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
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import HF_LEROBOT_HOME
from torch import Tensor

from lerobot_playbyear.datasets.confines import check_info, file_inside, open_picture
from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked
from lerobot_playbyear.datasets.video_pictures import video_pictures

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.opening import LongDataset

_ROWS_AT_ONCE = 128  # images
_VALUES_AT_ONCE = 2**22
Progress = Callable[[str, int], Any]
"""Called with a key and the number of its frames that were just decoded."""


def column_to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    """A column of numbers or of fixed-length lists of numbers, as an array (N,) or (N, values per row).

    Raises:
        ValueError: If rows are missing or of different lengths.
    """
    parts = [_flat(chunk) for chunk in column.chunks]
    flat = np.concatenate(parts) if parts else np.empty(0)
    if not _is_list(column.type):
        return flat
    if len(column) == 0 or len(flat) % len(column):
        raise ValueError(f"{len(flat)} values in {len(column)} rows: the rows differ in length, or some are missing")
    return flat.reshape(len(column), -1)


def read_values(dataset: "LeRobotDataset | LongDataset", key: str) -> Tensor:
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


def read_images(dataset: "LeRobotDataset | LongDataset", key: str, progress: Progress | None = None) -> Tensor:
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
    dataset: "LeRobotDataset | LongDataset",
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


def episode_bounds(episode_index: np.ndarray) -> tuple[list[int], list[int]]:
    """First row, and row after the last, of every episode, from the episode of each row (N,)."""
    changes = np.flatnonzero(np.diff(episode_index)) + 1
    starts = [0, *changes.tolist()]
    return starts, [*starts[1:], len(episode_index)]


def check_dataset_files(repo_id: str, root: str | Path | None = None, revision: str | None = None) -> None:
    """Refuse a local dataset that is empty or was cut off while it was written, or that no one should trust.

    Where no local dataset is, what the Hub's says about itself is fetched and checked; the rest LeRobot fetches later.

    Args:
        repo_id: The dataset's name.
        root: Its folder; None means LeRobot's own place for `repo_id`.
        revision: Of the dataset on the Hub, as LeRobot takes it.

    Raises:
        ValueError: Naming the file that is damaged, the folder without data, or what leads out of the folder or claims
            more than is there.
        OSError: A file cannot be read now, which says nothing about what it holds.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if not (folder / "meta" / "info.json").is_file():
        meta = LeRobotDatasetMetadata(repo_id, root=root, revision=revision)
        check_info(Path(meta.root), [], 0 if meta.episodes is None else len(meta.episodes))
        return
    footers: dict[str, list[pq.FileMetaData]] = {"data": [], "meta": []}
    for path in [*list_files(folder, "data/*/*.parquet"), *list_files(folder, "meta/episodes/*/*.parquet")]:
        try:
            with open_checked(path) as file:
                footers[path.relative_to(folder).parts[0]].append(file.metadata)
        except ParquetDamageError as error:
            raise ValueError(
                f"'{path}' is truncated or not a parquet file ({error}). If the recording was "
                f"killed, its episodes can be saved: playbyear-repair --root={folder}"
            ) from error
    if not footers["data"]:
        raise ValueError(f"The dataset '{repo_id}' in '{folder}' is empty: no episode was saved. Record at least one.")
    check_info(folder, footers["data"], sum(footer.num_rows for footer in footers["meta"]))


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


def _is_list(kind: pa.DataType) -> bool:
    return isinstance(kind, pa.BaseExtensionType) or pa.types.is_nested(kind)


def _flat(chunk: pa.Array) -> np.ndarray:
    while _is_list(chunk.type):
        chunk = chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk.flatten()
    if chunk.null_count:
        raise ValueError(f"{chunk.null_count} values are missing")
    return chunk.to_numpy(zero_copy_only=False)
