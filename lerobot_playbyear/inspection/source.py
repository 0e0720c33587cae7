"""The whole episodes of a dataset, as the checks and the page read them: an episode's numbers and sound at once, its pictures
one by one.

Unlike training, inspection has to read what is wrong: NaN is a finding here, not an error.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.features import audio_keys
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH
from lerobot_playbyear.datasets.info import INDEX_COLUMNS, InfoError, OutsideError, check_claims, check_dataset_files
from lerobot_playbyear.datasets.parquet import column_to_numpy
from lerobot_playbyear.datasets.pictures import open_picture, video_pictures
from lerobot_playbyear.datasets.survey import STATS_PATH, DatasetDamagedError, Frames, Survey, survey
from lerobot_playbyear.datasets.survey import Episode as SurveyedEpisode
from lerobot_playbyear.datasets.video_files import TOLERANCE_S, film_path

SUCCESS = "next.success"
INTERVENTION = "intervention"

FULL_SCALE = 32768.0
"""Of 16-bit PCM, in its steps."""

_PICTURES_AT_ONCE = 128  # encoded ones that are taken out of the table together
_LISTED = 3  # findings


class InspectionError(PlaybyearError, RuntimeError):
    """The dataset cannot be opened at all; the message is for the person who asked."""


@dataclass(frozen=True)
class Episode:
    """Where an episode is.

    Args:
        index: Its number in the dataset.
        start: Its first row, counted through all episodes that are looked at.
        stop: The row after its last; earlier than the episode's end where only its beginning is looked at.
        found: What the survey says of it.
    """

    index: int
    start: int
    stop: int
    found: SurveyedEpisode

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def rows(self) -> slice:
        return slice(self.start, self.stop)

    @property
    def frames(self) -> Frames:
        """Where its frames are."""
        assert self.found.frames is not None
        return self.found.frames


class DatasetSource:
    """Reads a dataset, with or without sound, ours or another tool's.

    Args:
        repo_id: Its name.
        found: The survey of its folder.
        episodes: Only these; None: all. Of those that are not whole the survey's findings tell.
        video_backend: LeRobot's decoder ("pyav", "torchcodec"); None takes its default.

    Attributes:
        repo_id: Its name.
        root: Its folder.
        survey: The survey.
        info: What its `meta/info.json` says.
        fps: Frames per second [Hz].
        features: Every feature.
        stats: Its statistics; empty where they cannot be read.
        cameras: The keys of all colour cameras.
        microphones: The keys of all microphones.
        chosen: The numbers of the episodes that are asked for; None: all.
        episodes: The whole episodes, in the order of their numbers.
    """

    def __init__(
        self, repo_id: str, found: Survey, episodes: Sequence[int] | None = None, video_backend: str | None = "pyav"
    ) -> None:
        self.repo_id, self.root, self.survey, self.info = repo_id, found.root, found, found.info
        self.fps = int(found.info["fps"])
        self.features: dict[str, dict[str, Any]] = found.info["features"]
        self._video_backend = video_backend
        self._values: dict[str, np.ndarray] = {}
        self.cameras = [key for key, feature in self.features.items() if _is_camera(feature)]
        self.microphones = audio_keys(self.features)
        self.chosen = None if episodes is None else set(episodes)
        self.episodes: list[Episode] = []
        for episode in found.whole:
            if episode.frames and (self.chosen is None or episode.number in self.chosen):
                start = self.episodes[-1].stop if self.episodes else 0
                self.episodes.append(Episode(episode.number, start, start + episode.frames.length, episode))

    @classmethod
    def open(
        cls,
        repo_id: str,
        root: str | Path | None = None,
        episodes: list[int] | None = None,
        video_backend: str | None = "pyav",
        damaged: bool = False,
    ) -> "DatasetSource":
        """Open a dataset from its folder, or by its name from LeRobot's cache or the Hub.

        Args:
            repo_id, root, episodes, video_backend: As above; without a root, where LeRobot has it, or fetches it to.
            damaged: Whether one that is damaged is read as far as it is whole.

        Raises:
            InspectionError: If there is none, or it claims what is not there, or it is damaged.
        """
        folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
        if root is not None and not (folder / INFO_PATH).is_file():
            found = "it does not exist" if not folder.exists() else f"it has no {INFO_PATH}"
            raise InspectionError(f"There is no LeRobotDataset in '{folder}': {found}. Check --dataset.root.")
        if not (folder / INFO_PATH).is_file():
            folder = _fetch(repo_id, folder, episodes)
        try:
            surveyed = survey(folder, thorough=False)
            files = {each.frames.file.path: each.frames.file for each in surveyed.whole if each.frames}
            check_claims(folder, [file.footer for file in files.values()], len(surveyed.episodes))
        except (OutsideError, InfoError, DatasetDamagedError) as error:
            raise InspectionError(str(error)) from error
        except (OSError, MemoryError) as error:
            said = f"it cannot be read now ({error or 'not enough memory'}); that is no damage, and may pass"
            raise InspectionError(f"The dataset in '{folder}' cannot be opened: {said}.") from error
        source = cls(repo_id, surveyed, episodes, video_backend)
        if surveyed.damage and not (damaged and source.episodes):
            raise InspectionError(
                f"The dataset in '{folder}' cannot be opened: {_listed(surveyed)}. Repair it: playbyear-repair --root={folder}"
            )
        if not source.episodes:
            raise InspectionError(f"The dataset in '{folder}' is empty: no episode was saved. Record at least one.")
        return source

    def __len__(self) -> int:
        """The number of frames, N."""
        return self.episodes[-1].stop

    @cached_property
    def stats(self) -> dict[str, dict[str, Any]]:
        try:
            return json.loads((self.root / STATS_PATH).read_bytes())
        except (OSError, ValueError):
            return {}  # the survey says so

    @cached_property
    def numbers(self) -> list[str]:
        """The keys of all other numeric features of one dimension that can be read, without LeRobot's index columns."""
        return [
            key
            for key, feature in self.features.items()
            if self._is_number(key, feature) and key not in self.unreadable
        ]

    @cached_property
    def unreadable(self) -> dict[str, str]:
        """The columns of numbers and of sound that lack values, or whose rows differ in length, and why."""
        reasons = {}
        for key, feature in self.features.items():
            try:
                if key in self.microphones:
                    self._check_sound(key, math.prod(feature["shape"]))
                elif self._is_number(key, feature):
                    self.values(key)
            except ValueError as error:
                reasons[key] = " ".join(str(error).split())
        return reasons

    def block(self, key: str, episode: Episode) -> np.ndarray:
        """An episode of a numeric column as stored, (n, D).

        Raises:
            ValueError: If values are missing, or rows differ in length.
        """
        frames = episode.frames
        column = frames.file.read(frames.start, frames.start + len(episode), [key]).column(key)
        return column_to_numpy(column).reshape(len(episode), -1)

    def values(self, key: str) -> np.ndarray:
        """A numeric column as stored, (N,) or (N, D).

        Raises:
            ValueError: As `block`.
        """
        if key not in self._values:
            values = np.concatenate([self.block(key, episode) for episode in self.episodes])
            self._values[key] = values[:, 0] if values.shape[1] == 1 else values
        return self._values[key]

    def rows(self, key: str) -> np.ndarray:
        """A numeric column, (N, D) float64.

        Raises:
            ValueError: As `block`.
        """
        return self.values(key).reshape(len(self), -1).astype(np.float64)

    @property
    def motion_key(self) -> str | None:
        """What says how the arm moved: the state, or the action in a dataset without one."""
        return next((key for key in ("observation.state", "action") if key in self.numbers), None)

    def sound(self, key: str, episode: Episode) -> np.ndarray:
        """What a microphone heard in an episode, (n * S,) float32 in steps of 16-bit PCM.

        NaN and infinite samples, a finding of their own, are 0.

        Raises:
            ValueError: As `block`.
        """
        block = self.block(key, episode)
        if block.dtype.kind == "f":
            block = np.nan_to_num(block * FULL_SCALE, nan=0.0, posinf=0.0, neginf=0.0)
        return block.reshape(-1).astype(np.float32)

    def task(self, episode: Episode) -> str:
        """The episode's first task in words; empty if it has no text."""
        return self.survey.tasks.get(episode.frames.tasks[0], "")

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
        feature, frames = self.features[camera], episode.frames
        if feature["dtype"] == "video":
            place = episode.found.places[camera]
            path = film_path(self.root, self.info, camera, place)
            times = [place.start + float(time) for time in self.block("timestamp", episode)[:, 0]]
            yield from video_pictures(path, times, TOLERANCE_S, camera, feature["shape"])
            return
        column = frames.file.read(frames.start, frames.start + len(episode), [camera]).column(camera)
        for first in range(0, len(column), _PICTURES_AT_ONCE):
            for row in column.slice(first, _PICTURES_AT_ONCE).to_pylist():
                with open_picture(row, self.root, camera, feature) as image:
                    yield np.asarray(image.convert("RGB"))

    def facts(self) -> dict[str, Any]:
        """What the dataset is, for the head of a report; in JSON's numbers."""
        facts = {
            "repo_id": self.repo_id,
            "root": str(self.root),
            "robot_type": self.info.get("robot_type"),
            "fps": self.fps,
            "episodes": len(self.episodes),
            "frames": len(self),
            "seconds": len(self) / self.fps,
            "cameras": {key: list(self.features[key]["shape"]) for key in self.cameras},
            "microphones": {key: (self.features[key].get("info") or {}).get("sample_rate") for key in self.microphones},
            "tasks": sorted({self.task(episode) for episode in self.episodes}),
        }
        return {name: finite(value) for name, value in facts.items()}

    def _check_sound(self, key: str, n_samples: int) -> None:
        for episode in self.episodes:
            if (held := self.block(key, episode).shape[1]) != n_samples:
                raise ValueError(f"rows of episode {episode.index} hold {held} samples; {INFO_PATH} says {n_samples}")

    def _is_number(self, key: str, feature: dict[str, Any]) -> bool:
        is_other = key in INDEX_COLUMNS or key in self.microphones
        is_number = feature["dtype"] not in ("image", "video", "string", "language")
        return is_number and not is_other and len(feature["shape"]) <= 1


def finite(value: Any) -> Any:
    """The same for JSON, which has no NaN and no infinite numbers, though Python reads them in one: null for each."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, list | tuple) else value


def _fetch(repo_id: str, folder: Path, episodes: list[int] | None) -> Path:
    """Lets LeRobot fetch a dataset from the Hub, or find it in its cache. Returns its folder."""
    from lerobot.datasets import LeRobotDataset

    try:
        check_dataset_files(repo_id)  # before its data come
        return Path(LeRobotDataset(repo_id, episodes=episodes).root)
    except Exception as error:  # whatever LeRobot or the network may raise
        reason = " ".join(str(error.__cause__ or error).split()) or type(error).__name__
        where = f"'{repo_id}' (neither in '{folder}' nor from the Hub)"
        raise InspectionError(f"The dataset {where} cannot be opened: {reason}") from error


def _listed(found: Survey) -> str:
    lines = [str(finding) for finding in found.damage]
    return "; ".join(lines[:_LISTED]) + (f"; and {len(lines) - _LISTED} more" if len(lines) > _LISTED else "")


def _is_camera(feature: dict[str, Any]) -> bool:
    details = feature.get("info") or {}
    is_depth = details.get("is_depth_map") or details.get("video.is_depth_map")
    return feature["dtype"] in ("image", "video") and not is_depth
