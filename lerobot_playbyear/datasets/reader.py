"""A LeRobotDataset read by columns and episodes, from its own files.

LeRobot reads row by row, every value as a Python object, and copies all files into its cache first. Here a column becomes
numpy arrays through Arrow. An episode is the unit of memory for sound and numbers; pictures come one by one.

What is read is not judged: NaN is data, for `playbyear-inspect` reports it and training refuses it.
"""

import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from lerobot_playbyear.datasets.features import AUDIO_DTYPE, audio_keys, check_audio_features
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, list_files
from lerobot_playbyear.datasets.info import check_dataset_files, file_inside
from lerobot_playbyear.datasets.parquet import DataFile, column_to_numpy, episode_bounds
from lerobot_playbyear.datasets.pictures import open_picture, video_pictures

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

TOLERANCE_S = 1e-4
"""How far a video's picture may be from its frame's time, as in LeRobot [s]."""

_PICTURES_AT_ONCE = 64  # that are decoded ahead


@dataclass
class DatasetPlace:
    """A dataset's name and place.

    Args:
        repo_id: Its name, `user/name`.
        root: Its folder. None: in LeRobot's own cache, under its name.
    """

    repo_id: str
    root: str | None = None

    @property
    def folder(self) -> Path:
        """Where it is, or is to be."""
        return Path(self.root) if self.root else HF_LEROBOT_HOME / self.repo_id


@dataclass(frozen=True)
class EpisodeRows:
    """Where an episode is.

    Args:
        index: Its number in the dataset.
        start: Its first row.
        stop: The row after its last.
    """

    index: int
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def rows(self) -> slice:
        return slice(self.start, self.stop)


class DatasetReader:
    """Reads a dataset, local or from the Hub. Rows are numbered as `LeRobotDataset[i]` numbers them.

    Args:
        repo_id: Its name.
        root: Its folder; None: LeRobot's own place for `repo_id`, or else the Hub.
        episodes: Only these; None: all.
        meta: What LeRobot has read of it already.

    Attributes:
        repo_id: Its name.
        root: Its folder.
        meta: What LeRobot knows of it.
        fps: Frames per second [Hz].
        features: Every feature, as `meta.features`.
        episodes: The episodes, in the order of their rows.

    Raises:
        ValueError: A file of the dataset is truncated, or it is empty, or it says what no one should trust, or its sound
            lies in files beside the frames.
        Exception: Whatever LeRobot raises where there is none, or it cannot be read.
    """

    def __init__(
        self,
        repo_id: str,
        root: str | Path | None = None,
        episodes: Sequence[int] | None = None,
        *,
        meta: "LeRobotDatasetMetadata | None" = None,
    ) -> None:
        if meta is None:
            is_local = bool(check_dataset_files(repo_id, root))
            from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

            if is_local:
                meta = LeRobotDatasetMetadata(repo_id, root)
            else:  # it fetches what is missing
                meta = LeRobotDataset(repo_id, root, episodes=None if episodes is None else list(episodes)).meta
        self.meta, self.repo_id, self.root = meta, meta.repo_id, Path(meta.root)
        self.fps, self.features = int(meta.fps), meta.features
        check_audio_features({key: own for key, own in self.features.items() if own["dtype"] == AUDIO_DTYPE}, self.fps)
        self._files = [DataFile(path) for path in list_files(self.root, "data/*/*.parquet")]
        self._firsts = [0, *itertools.accumulate(file.n_rows for file in self._files)]
        self._rows: np.ndarray = np.arange(self._firsts[-1])  # where each row here is in the files, in order
        numbers = self.values("episode_index")
        if episodes is not None:
            self._rows = np.flatnonzero(np.isin(numbers, list(episodes)))
            numbers = numbers[self._rows]
        bounds = zip(*episode_bounds(numbers), strict=True) if len(numbers) else ()
        self.episodes = [EpisodeRows(int(numbers[start]), start, stop) for start, stop in bounds]

    @classmethod
    def of(cls, dataset: "LeRobotDataset") -> "DatasetReader":
        """Reads what LeRobot has opened: the same episodes of the same files."""
        return cls(dataset.repo_id, dataset.root, dataset.episodes, meta=dataset.meta)

    def __len__(self) -> int:
        """The number of frames, N."""
        return len(self._rows)

    @property
    def cameras(self) -> list[str]:
        """The keys of all colour cameras."""
        return [key for key in self.meta.camera_keys if key not in self.meta.depth_keys]

    @property
    def microphones(self) -> list[str]:
        """The keys of all microphones."""
        return audio_keys(self.features)

    def values(self, key: str, episode: EpisodeRows | None = None) -> np.ndarray:
        """A column of numbers as stored, (n, *shape), or (n,) where each row has one value.

        Args:
            key: Its feature.
            episode: Only the rows of this one; None: all.

        Raises:
            ValueError: Values are missing, or rows differ in length or from the feature's shape, or the file is damaged.
        """
        start, stop = (0, len(self)) if episode is None else (episode.start, episode.stop)
        shape = tuple(self.features[key]["shape"])
        parts = [column_to_numpy(column) for column in self._columns(key, start, stop)]
        try:
            return np.concatenate(parts).reshape(stop - start, *(() if shape == (1,) else shape))
        except ValueError as error:
            raise ValueError(
                f"'{key}' of dataset '{self.repo_id}' cannot be read as {stop - start} rows of shape {shape}: {error}. "
                "Record the damaged episodes again, or leave them out with --dataset.episodes."
            ) from error

    def sound(self, key: str, episode: EpisodeRows) -> np.ndarray:
        """What a microphone heard in an episode, (n_frames * S,) as stored. Raises as `values`."""
        return self.values(key, episode).reshape(-1)

    def pictures(self, key: str, episode: EpisodeRows, first: int = 0) -> Iterator[np.ndarray]:
        """An episode's frames of one camera, each (H, W, C) uint8.

        Args:
            key: The camera.
            episode: The episode.
            first: The frame to begin with, counted from the episode's start.

        Raises:
            Exception: Whatever the decoder raises on a damaged picture or video; also where one lies outside the folder,
                is missing, or has another size than the feature says.
        """
        feature = self.features[key]
        if feature["dtype"] == "video":
            path = file_inside(self.root, self.meta.get_video_file_path(episode.index, key))
            begin = self.meta.episodes[episode.index][f"videos/{key}/from_timestamp"]
            times = [begin + float(time) for time in self.values("timestamp", episode)[first:]]
            yield from video_pictures(path, times, TOLERANCE_S, key, feature["shape"])
            return

        def decode(row: dict[str, Any] | None) -> np.ndarray:
            with open_picture(row, self.root, key, feature) as image:
                pixels = np.asarray(image.convert("L" if 1 in (feature["shape"][0], feature["shape"][-1]) else "RGB"))
            return pixels[..., None] if pixels.ndim == 2 else pixels

        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            for column in self._columns(key, episode.start + first, episode.stop):
                for start in range(0, len(column), _PICTURES_AT_ONCE):
                    yield from pool.map(decode, column.slice(start, _PICTURES_AT_ONCE).to_pylist())

    def task(self, episode: EpisodeRows) -> str:
        """The episode's task in words; empty if it has none."""
        number = int(self.values("task_index", EpisodeRows(episode.index, episode.start, episode.start + 1))[0])
        tasks = self.meta.tasks
        return str(tasks.index[number]) if tasks is not None and 0 <= number < len(tasks) else ""

    def _columns(self, key: str, start: int, stop: int) -> Iterator[pa.ChunkedArray]:
        """The rows from `start` to before `stop` of a column, file by file."""
        rows = self._rows[start:stop]
        for file, first in zip(self._files, self._firsts, strict=False):
            own = rows[slice(*np.searchsorted(rows, [first, first + file.n_rows]))] - first
            if len(own):
                column = file.read(int(own[0]), int(own[-1]) + 1, [key]).column(key)
                yield column if len(column) == len(own) else column.take(own - own[0])


def check_finite(reader: DatasetReader, key: str) -> None:
    """Refuses NaN and infinite values in a column of numbers, episode by episode.

    Raises:
        ValueError: Naming the episodes that hold them.
    """
    wrong = [episode for episode in reader.episodes if not np.isfinite(reader.values(key, episode)).all()]
    if wrong:
        names = ", ".join(str(episode.index) for episode in wrong[:10]) + (" ..." if len(wrong) > 10 else "")
        raise ValueError(
            f"'{key}' holds NaN or infinite values in {len(wrong)} of {len(reader.episodes)} episodes ({names}); wanted "
            "finite numbers. Record these episodes again, or leave them out with --dataset.episodes."
        )
