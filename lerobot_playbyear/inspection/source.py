"""A dataset as the checks and the page read it: numbers at once, sound and pictures piece by piece.

Unlike training, inspection has to read what is wrong: NaN is a finding here, not an error.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_playbyear.datasets.confines import open_picture
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.features import audio_keys
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH
from lerobot_playbyear.datasets.info import InfoError, OutsideError, file_inside
from lerobot_playbyear.datasets.opening import open_dataset
from lerobot_playbyear.datasets.parquet import column_to_numpy, episode_bounds
from lerobot_playbyear.inspection.waveform import PIECE, EpisodeSound

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

SUCCESS = "next.success"
INTERVENTION = "intervention"

_INDEX_COLUMNS = ("timestamp", "frame_index", "task_index")
_PICTURES_AT_ONCE = 128  # encoded ones that are taken out of the table together


class InspectionError(PlaybyearError, RuntimeError):
    """The dataset cannot be opened at all; the message is for the person who asked."""


@dataclass(frozen=True)
class Episode:
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


class DatasetSource:
    """Reads an opened LeRobotDataset, with or without sound, ours or another tool's.

    Args:
        dataset: Opened; the episodes it was opened with are inspected.
        video_backend: LeRobot's decoder ("pyav", "torchcodec"); None takes its default.

    Attributes:
        dataset: The dataset.
        fps: Frames per second [Hz].
        features: Every feature, as `dataset.meta.features`.
        cameras: The keys of all colour cameras.
        microphones: The keys of all microphones.
    """

    def __init__(self, dataset: "LeRobotDataset | LongDataset", video_backend: str | None = "pyav") -> None:
        self.dataset = dataset
        self.fps = int(dataset.fps)
        self.features: dict[str, dict[str, Any]] = dataset.meta.features
        self._video_backend = video_backend
        self._table = dataset.hf_dataset.data
        self._values: dict[str, np.ndarray] = {}
        self._samples_per_frame: dict[str, int] = {}
        self.cameras = [key for key in dataset.meta.camera_keys if key not in dataset.meta.depth_keys]
        self.microphones = audio_keys(self.features)

    @classmethod
    def open(
        cls,
        repo_id: str,
        root: str | Path | None = None,
        episodes: list[int] | None = None,
        video_backend: str | None = "pyav",
    ) -> "DatasetSource":
        """Open a dataset from its folder, or by its name from LeRobot's cache or the Hub.

        Raises:
            InspectionError: If there is none, or LeRobot cannot read it.
        """
        folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
        if root is not None and not (folder / INFO_PATH).is_file():
            found = "it does not exist" if not folder.exists() else f"it has no {INFO_PATH}"
            raise InspectionError(f"There is no LeRobotDataset in '{folder}': {found}. Check --dataset.root.")
        try:
            dataset = open_dataset(repo_id, root, episodes, video_backend)
            source = cls(dataset, video_backend)
            n_episodes = len(source.episodes)
        except (OutsideError, InfoError) as error:
            raise InspectionError(str(error)) from error
        except Exception as error:  # whatever LeRobot, Arrow or the network may raise
            where = f"in '{folder}'" if root is not None else f"'{repo_id}' (neither in '{folder}' nor from the Hub)"
            from lerobot_playbyear.inspection.damage import find_damage

            reason = find_damage(folder) or " ".join(str(error.__cause__ or error).split()) or type(error).__name__
            raise InspectionError(f"The dataset {where} cannot be opened: {reason}") from error
        if n_episodes == 0:
            raise InspectionError(f"The dataset in '{dataset.root}' is empty: it has no frames.")
        return source

    def __len__(self) -> int:
        """The number of frames, N."""
        return int(self._table.num_rows)

    @cached_property
    def episodes(self) -> list[Episode]:
        """The episodes in the order of their rows."""
        index = self.values("episode_index")
        if len(index) == 0:
            return []
        return [Episode(int(index[start]), start, stop) for start, stop in zip(*episode_bounds(index), strict=True)]

    @cached_property
    def numbers(self) -> list[str]:
        """The keys of all other numeric features of one dimension that can be read, without LeRobot's index columns."""
        keys = [key for key, feature in self.features.items() if self._is_number(key, feature)]
        return [key for key in keys if key not in self.unreadable]

    @cached_property
    def unreadable(self) -> dict[str, str]:
        """The columns of numbers and of sound that lack values, or whose rows differ in length, and why."""
        reasons = {}
        for key, feature in self.features.items():
            try:
                if key in self.microphones:
                    self.samples_per_frame(key)
                elif key in _INDEX_COLUMNS or self._is_number(key, feature):
                    self.values(key)
            except ValueError as error:
                reasons[key] = " ".join(str(error).split())
        return reasons

    def values(self, key: str) -> np.ndarray:
        """A numeric column as stored, (N,) for one value per row and (N, D) for more; read once.

        Raises:
            ValueError: If values are missing, or rows differ in length.
        """
        if key not in self._values:
            values = column_to_numpy(self._table.column(key))
            self._values[key] = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
        return self._values[key]

    def rows(self, key: str) -> np.ndarray:
        """A numeric column, (N, D) float64.

        Raises:
            ValueError: As `values`.
        """
        return self.values(key).reshape(len(self), -1).astype(np.float64)

    @property
    def motion_key(self) -> str | None:
        """What says how the arm moved: the state, or the action in a dataset without one."""
        from lerobot.utils.constants import ACTION, OBS_STATE

        return next((key for key in (OBS_STATE, ACTION) if key in self.numbers), None)

    def pieces(self, key: str) -> Iterator[tuple[int, np.ndarray]]:
        """A numeric column as stored, in parts of bounded size: the first row of each, and its values (n, D).

        Raises:
            ValueError: If values are missing, or rows differ in length.
        """
        column = self._table.column(key)
        width = max(column_to_numpy(column.slice(0, 1)).size, 1) if len(column) else 1
        rows = max(PIECE // width, 1)
        for first in range(0, len(column), rows):
            values = column_to_numpy(column.slice(first, rows))
            values = values.reshape(len(values), -1)
            if values.shape[1] != width:
                raise ValueError(f"'{key}': rows hold {width} values, and {values.shape[1]} from row {first} on")
            yield first, values

    def samples_per_frame(self, key: str) -> int:
        """How many samples each row of a microphone holds, S.

        Raises:
            ValueError: If values are missing, or rows differ in length.
        """
        if key not in self._samples_per_frame:
            for _, values in self.pieces(key):
                self._samples_per_frame[key] = values.shape[1]
        return self._samples_per_frame[key]

    def sound(self, key: str, episode: Episode) -> EpisodeSound:
        """What a microphone heard in an episode; it is read where it is indexed.

        Raises:
            ValueError: If values are missing, or rows differ in length.
        """
        return EpisodeSound(self._table.column(key).slice(episode.start, len(episode)), self.samples_per_frame(key))

    def task(self, episode: Episode) -> str:
        """The episode's task in words; empty if it has none, or which one cannot be read."""
        tasks = self.dataset.meta.tasks
        if tasks is None or "task_index" not in self.features or "task_index" in self.unreadable:
            return ""
        position = int(self.values("task_index")[episode.start])
        return str(tasks.index[position]) if 0 <= position < len(tasks) else ""

    def succeeded(self, episode: Episode) -> int | None:
        """The first frame, counted from the episode's start, with success; -1 without success, None if not known."""
        if SUCCESS not in self.numbers:
            return None
        frames = np.flatnonzero(self.values(SUCCESS)[episode.rows])
        return int(frames[0]) if len(frames) else -1

    def pictures(self, episode: Episode, camera: str) -> Iterator[np.ndarray]:
        """The episode's frames of one camera, each (H, W, 3) uint8.

        Raises:
            Exception: Whatever the decoder raises on a damaged picture or video.
        """
        if self.features[camera]["dtype"] == "video":
            yield from self._video(episode, camera)
            return
        column = self._table.column(camera).slice(episode.start, len(episode))
        for first in range(0, len(column), _PICTURES_AT_ONCE):
            for row in column.slice(first, _PICTURES_AT_ONCE).to_pylist():
                with open_picture(row, Path(self.dataset.root), camera, self.features[camera]) as image:
                    yield np.asarray(image.convert("RGB"))

    def _video(self, episode: Episode, camera: str) -> Iterator[np.ndarray]:
        from lerobot_playbyear.datasets.video_pictures import video_pictures

        meta = self.dataset.meta
        path = file_inside(Path(self.dataset.root), meta.get_video_file_path(episode.index, camera))
        offset = meta.episodes[episode.index][f"videos/{camera}/from_timestamp"]
        times = [offset + float(time) for time in self.values("timestamp")[episode.rows]]
        shape = self.features[camera]["shape"]
        yield from video_pictures(path, times, self.dataset.tolerance_s, self._video_backend, camera, shape)

    def _is_number(self, key: str, feature: dict[str, Any]) -> bool:
        from lerobot.datasets.language import LANGUAGE_COLUMNS
        from lerobot.utils.constants import DEFAULT_FEATURES

        return (
            key not in DEFAULT_FEATURES
            and key not in self.microphones
            and key not in LANGUAGE_COLUMNS
            and feature["dtype"] not in ("image", "video", "string")
            and len(feature["shape"]) <= 1
        )
