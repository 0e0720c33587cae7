"""A LeRobotDataset read by columns and episodes, from its own files.

LeRobot reads row by row, every value as a Python object, and copies all files into its cache first. Here a column becomes
numpy arrays through Arrow. An episode is the unit of memory for sound and numbers; pictures come one by one.

`DatasetReader` reads what LeRobot's metadata say, for training and copies; `SurveyedDataset` what a survey calls whole, for
inspection and uploads. What is read is not judged: NaN is data, for `playbyear-inspect` reports it and training refuses it.
"""

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from lerobot_playbyear.datasets.errors import InputError, errors_of_input, first_line
from lerobot_playbyear.datasets.features import AUDIO_DTYPE, Features, audio_keys, check_audio_features, is_depth
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH, is_special, list_files
from lerobot_playbyear.datasets.findings import name_episodes
from lerobot_playbyear.datasets.frame_rate import frame_rate
from lerobot_playbyear.datasets.info import INDEX_COLUMNS, check_parts, file_inside, list_folder, nothing_in, read_info
from lerobot_playbyear.datasets.parquet import PIECE_BYTES, DataFile, column_to_numpy, episode_bounds, holds_numbers
from lerobot_playbyear.datasets.pictures import open_picture, video_pictures
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.datasets.survey import Survey, survey
from lerobot_playbyear.datasets.video_files import TOLERANCE_S, film_path

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

_PICTURES_AT_ONCE = 64  # that are decoded ahead; fewer of large ones
_LISTED = 3  # findings
_MOST_CLAIMED = 4  # times as many episodes as are there; less than that is damage, which the survey names


@dataclass
class DatasetPlace:
    """A dataset's name and place.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder. None: the one in LeRobot's cache.
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


class EpisodeReader:
    """Reads episodes whose frames lie in some data files. Rows are numbered through the episodes, in the files' order.

    Args:
        repo_id: The dataset's name.
        root: Its folder.
        fps: Frames per second [Hz].
        features: Every feature.
        files: Its data files.
        tasks: The text of each task.

    Attributes:
        repo_id, root, fps, features, files, tasks: As above.
        episodes: The episodes, in the order of their rows.
    """

    def __init__(
        self, repo_id: str, root: Path, fps: float, features: Features, files: list[DataFile], tasks: Mapping[int, str]
    ) -> None:
        self.repo_id, self.root, self.fps, self.features, self.tasks = repo_id, root, fps, features, tasks
        self.episodes: list[EpisodeRows] = []
        self.files = files
        self._firsts: np.ndarray = np.cumsum([0, *(file.n_rows for file in self.files)])
        self._rows: np.ndarray = np.arange(self._firsts[-1])  # where each row here is in the files, in order

    def __len__(self) -> int:
        """The number of frames, N."""
        return len(self._rows)

    @property
    def cameras(self) -> list[str]:
        """The keys of all colour cameras."""
        pictures = [key for key, feature in self.features.items() if feature["dtype"] in ("image", "video")]
        return [key for key in pictures if not is_depth(self.features[key])]

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
        try:
            parts = [column_to_numpy(column) for column in self._columns(key, start, stop)]
            return np.concatenate(parts).reshape(stop - start, *(() if shape == (1,) else shape))
        except ValueError as error:
            raise ValueError(
                f"'{key}' of dataset '{self.repo_id}' cannot be read as {stop - start} rows of shape {shape}: {error}. "
                "Record the damaged episodes again, leave them out with --dataset.episodes, or correct meta/info.json."
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
            path, begin = self._film(key, episode)
            times = [begin + float(time) for time in self.values("timestamp", episode)[first:]]
            yield from video_pictures(path, times, TOLERANCE_S, key, feature["shape"])
            return

        def decode(row: dict[str, Any] | None) -> np.ndarray:
            with open_picture(row, self.root, key, feature) as image:
                pixels = np.asarray(image.convert("L" if 1 in (feature["shape"][0], feature["shape"][-1]) else "RGB"))
            return pixels[..., None] if pixels.ndim == 2 else pixels

        at_once = max(min(_PICTURES_AT_ONCE, PIECE_BYTES // max(math.prod(feature["shape"]), 1)), 1)
        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            for column in self._columns(key, episode.start + first, episode.stop):
                for start in range(0, len(column), at_once):
                    yield from pool.map(decode, column.slice(start, at_once).to_pylist())

    def task(self, episode: EpisodeRows) -> str:
        """The episode's task in words; empty if it has none."""
        number = self.values("task_index", EpisodeRows(episode.index, episode.start, episode.start + 1))[0]
        return self.tasks.get(int(number), "")

    def _choose(self, found: Iterable[tuple[int, int, int]]) -> None:
        """Reads only these episodes: of each its number, its first row in all files, and how many."""
        rows = [np.empty(0, int)]
        for number, first, length in sorted(found, key=lambda episode: episode[1]):
            start = self.episodes[-1].stop if self.episodes else 0
            self.episodes.append(EpisodeRows(number, start, start + length))
            rows.append(np.arange(first, first + length))
        self._rows = np.concatenate(rows)

    def _film(self, key: str, episode: EpisodeRows) -> tuple[Path, float]:
        """The film with an episode's pictures, and when they begin in it [s]."""
        raise NotImplementedError

    def _columns(self, key: str, start: int, stop: int) -> Iterator[pa.ChunkedArray]:
        """The rows from `start` to before `stop` of a column, file by file."""
        rows = self._rows[start:stop]
        begin, end = np.searchsorted(self._firsts, rows[[0, -1]], side="right") if len(rows) else (1, 0)
        for file, first in zip(self.files[begin - 1 : end], self._firsts[begin - 1 :], strict=False):
            own = rows[slice(*np.searchsorted(rows, [first, first + file.n_rows]))] - first
            if len(own):
                column = file.read(int(own[0]), int(own[-1]) + 1, [key]).column(key)
                yield column if len(column) == len(own) else column.take(own - own[0])


class DatasetReader(EpisodeReader):
    """Reads a dataset, local or from the Hub. Rows are numbered as `LeRobotDataset[i]` numbers them.

    Args:
        repo_id: Its name.
        root: Its folder; None: LeRobot's own place for `repo_id`, or else the Hub.
        episodes: Only these; None: all.
        meta: What LeRobot has read of it already.
        may_have_audio_files: Whether its sound may lie in files beside the frames, which this class does not read.

    Attributes:
        meta: What LeRobot knows of it.

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
        may_have_audio_files: bool = False,
    ) -> None:
        if meta is None:
            is_local = check_dataset_files(repo_id, root)
            from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

            if not is_local:  # it fetches what is missing
                root = LeRobotDataset(repo_id, root, episodes=None if episodes is None else list(episodes)).root
                if episodes is None:
                    _refuse_damage(_look(Path(root)))
            meta = LeRobotDatasetMetadata(repo_id, root)
        self.meta = meta
        folder = Path(meta.root)
        files = [DataFile(path) for path in list_files(folder, "data/*/*.parquet")]
        tasks = {} if meta.tasks is None else dict(enumerate(meta.tasks.index.astype(str)))
        super().__init__(meta.repo_id, folder, frame_rate(meta.fps), meta.features, files, tasks)
        if not may_have_audio_files:
            _refuse_audio_files(self.features)
        numbers = self.values("episode_index")
        bounds = zip(*episode_bounds(numbers), strict=True) if len(numbers) else ()
        found = [(int(numbers[start]), start, stop - start) for start, stop in bounds]
        wanted = None if episodes is None else set(episodes)
        self._choose(each for each in found if wanted is None or each[0] in wanted)

    @classmethod
    def of(cls, dataset: "LeRobotDataset") -> "DatasetReader":
        """Reads what LeRobot has opened: the same episodes of the same files."""
        return cls(dataset.repo_id, dataset.root, dataset.episodes, meta=dataset.meta)

    def _film(self, key: str, episode: EpisodeRows) -> tuple[Path, float]:
        path = file_inside(self.root, self.meta.get_video_file_path(episode.index, key))
        return path, self.meta.episodes[episode.index][f"videos/{key}/from_timestamp"]


class SurveyedDataset(EpisodeReader):
    """Reads the episodes of a dataset that are whole, with or without sound, ours or another tool's.

    Args:
        repo_id: Its name.
        found: The survey of its folder.
        episodes: Only these; None: all. Of those that are not whole the survey's findings tell.

    Attributes:
        survey: The survey.
        info: What its `meta/info.json` says.
        chosen: The numbers of the episodes that are asked for; None: all.
    """

    def __init__(self, repo_id: str, found: Survey, episodes: Sequence[int] | None = None) -> None:
        frames = [each.frames for each in found.whole if each.frames]
        files = {each.file.path: each.file for each in frames}
        self.survey, self.info = found, found.info
        super().__init__(repo_id, found.root, found.info["fps"], found.info["features"], [*files.values()], found.tasks)
        self.chosen = None if episodes is None else set(episodes)
        self._places = {each.number: each.places for each in found.whole}
        first_of = dict(zip(files, self._firsts, strict=False))
        places = [(each.episode, first_of[each.file.path] + each.start, each.length) for each in frames]
        self._choose(place for place in places if self.chosen is None or place[0] in self.chosen)

    @classmethod
    def open(
        cls, repo_id: str, root: str | Path | None = None, episodes: list[int] | None = None, damaged: bool = False
    ) -> "SurveyedDataset":
        """Opens a dataset from its folder, or by its name from LeRobot's cache or the Hub.

        Args:
            repo_id, root, episodes: As above; without a root, where LeRobot has it, or fetches it to.
            damaged: Whether one that is damaged is read as far as it is whole.

        Raises:
            InputError: There is none, or it claims what is not there, or it is damaged.
        """
        folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
        if root is not None and not (folder / INFO_PATH).is_file():
            raise InputError(f"{nothing_in(folder)}. Correct the folder.")
        if not (folder / INFO_PATH).is_file():
            folder = _fetch(repo_id, folder, episodes)
        try:
            found = _look(folder)
        except (OSError, MemoryError) as error:
            said = f"it cannot be read now ({error or 'not enough memory'}); this is not damage, and may pass"
            raise InputError(f"The dataset in '{folder}' cannot be opened: {said}.") from error
        _refuse_audio_files(found.info["features"])
        dataset = cls(repo_id, found, episodes)
        if not (damaged and dataset.episodes):
            _refuse_damage(found)
        if not dataset.episodes:
            raise InputError(f"The dataset in '{folder}' is empty: no episode was saved. Record at least one.")
        return dataset

    @cached_property
    def numbers(self) -> list[str]:
        """The keys of all other numeric features of one dimension that can be read, without LeRobot's index columns."""
        return [key for key in self._columns_of_numbers() if key not in {*self.microphones, *self.unreadable}]

    @cached_property
    def timed_microphones(self) -> list[str]:
        """The microphones whose rows are what their sample rate says; of the others no moment in time is known."""
        wrong = {finding.feature for finding in self.survey.findings if finding.check == "sample rate"}
        return [key for key in self.microphones if key not in {*wrong, *self.unreadable}]

    @cached_property
    def unreadable(self) -> dict[str, str]:
        """The columns of numbers and of sound that lack values, or whose rows differ in length, and why."""
        numbers = self._columns_of_numbers()
        reasons = {key: f"'{key}' holds no numbers" for key in self.microphones if key not in numbers}
        for key in numbers:
            try:
                for episode in self.episodes:
                    self.values(key, episode)
            except ValueError as error:
                reasons[key] = " ".join(str(error).split())
        return reasons

    def pictures(self, key: str, episode: EpisodeRows, first: int = 0) -> Iterator[np.ndarray]:
        """As above, but each (H, W, 3) uint8, whatever the channels of the feature."""
        for picture in super().pictures(key, episode, first):
            yield np.broadcast_to(picture, (*picture.shape[:2], 3))

    def _columns_of_numbers(self) -> list[str]:
        vectors = [key for key, own in self.features.items() if len(own["shape"]) <= 1 and 0 not in own["shape"]]
        kinds = {field.name: field.type for field in self.survey.schema if holds_numbers(field.type)}
        return [key for key in vectors if key in kinds and key not in INDEX_COLUMNS]

    def _film(self, key: str, episode: EpisodeRows) -> tuple[Path, float]:
        place = self._places[episode.index][key]
        return film_path(self.root, self.info, key, place), place.start


def check_dataset_files(repo_id: str, root: str | Path | None = None, revision: str | None = None) -> bool:
    """Refuse a local dataset that is empty or damaged, or that no one should trust.

    Where no local dataset is, what the Hub's says about itself is fetched and checked; the rest LeRobot fetches later.

    Args:
        repo_id: The dataset's name.
        root: Its folder; None means LeRobot's own place for `repo_id`.
        revision: Of the dataset on the Hub, as LeRobot takes it.

    Returns:
        Whether there is a local dataset.

    Raises:
        InputError: Naming what is damaged, the folder without data, or what leads out of the folder or claims more than is
            there.
        OSError: A file cannot be read now, which says nothing about what it holds.
        MemoryError: There is no room for something.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if (folder / INFO_PATH).is_file() or is_special(folder / INFO_PATH):
        _refuse_damage(_look(folder))
        return True
    if list_folder(folder):  # LeRobot fetches into no folder that holds other files
        raise InputError(f"{nothing_in(folder)}. Correct the folder.")
    from lerobot.datasets import LeRobotDatasetMetadata

    try:
        meta = LeRobotDatasetMetadata(repo_id, root=root, revision=revision)
    except Exception as error:  # LeRobot's, the Hub's or the network's
        raise InputError(
            f"{nothing_in(folder)}, and '{repo_id}' could not be had from the Hub: {type(error).__name__}: "
            f"{first_line(error)}. Correct the name or the folder."
        ) from error
    _check_claims(Path(meta.root), 0 if meta.episodes is None else len(meta.episodes))
    return False


def _look(folder: Path) -> Survey:
    """A quick survey of a dataset that has all of its parts, and claims no more than is there."""
    check_parts(folder)
    found = survey(folder, thorough=False)
    _check_claims(folder, len(found.episodes))
    return found


def _check_claims(folder: Path, n_episodes: int) -> None:
    """Refuses a dataset whose `meta/info.json` claims far more episodes than there are."""
    total = read_info(folder)["total_episodes"]
    if total > _MOST_CLAIMED * max(n_episodes, 1):
        raise InputError(
            f"{folder / INFO_PATH}: total_episodes is {total:,}, but meta/episodes has {n_episodes:,}. "
            f"Repair it: {repair_command(folder)}"
        )


def _refuse_audio_files(features: Features) -> None:
    with errors_of_input():
        check_audio_features({key: own for key, own in features.items() if own["dtype"] == AUDIO_DTYPE}, 1)


def _refuse_damage(found: Survey) -> None:
    if not found.damage:
        return
    wrong = [str(finding) for finding in found.findings if finding.level == "error"]
    more = f"; and {len(wrong) - _LISTED} more" if len(wrong) > _LISTED else ""
    raise InputError(
        f"The dataset in '{found.root}' cannot be opened: {'; '.join(wrong[:_LISTED])}{more}. "
        f"Repair it: {repair_command(found.root)}"
    )


def _fetch(repo_id: str, folder: Path, episodes: list[int] | None) -> Path:
    """Lets LeRobot fetch a dataset from the Hub, or find it in its cache. Returns its folder."""
    from lerobot.datasets import LeRobotDataset

    try:
        check_dataset_files(repo_id)  # before its data come
        return Path(LeRobotDataset(repo_id, episodes=episodes).root)
    except Exception as error:  # whatever LeRobot or the network may raise
        reason = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        where = f"'{repo_id}' (neither in '{folder}' nor from the Hub)"
        raise InputError(f"The dataset {where} cannot be opened: {reason}") from error


def check_finite(reader: DatasetReader, key: str) -> None:
    """Refuses NaN and infinite values in a column of numbers, episode by episode.

    Raises:
        ValueError: Naming the episodes that hold them.
    """
    wrong = [each.index for each in reader.episodes if not np.isfinite(reader.values(key, each)).all()]
    if wrong:
        raise ValueError(
            f"'{key}' holds NaN or infinite values in {name_episodes(wrong)} of {len(reader.episodes)}; wanted "
            "finite numbers. Record these episodes again, or leave them out with --dataset.episodes."
        )
