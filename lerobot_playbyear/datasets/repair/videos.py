"""The films of each camera: whether they are whole, whether each episode's pictures are in them, and where."""

import glob
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.files import is_listed, list_files, naming
from lerobot_playbyear.datasets.repair.episodes import PLACE, Episode, Row, video_places
from lerobot_playbyear.datasets.repair.report import RepairReport, name_episodes
from lerobot_playbyear.datasets.repair.video_times import picture_times
from lerobot_playbyear.datasets.video_seal import is_intact

TOLERANCE = 1e-4  # seconds, LeRobot's own
_BOX_HEADER = 8


class Place(NamedTuple):
    """Where pictures are: in which file, and from when to when in it [s]."""

    name: Path
    start: float
    end: float


class Camera:
    """The video files of one camera. What was found out about a file is kept, and not read again.

    Args:
        root: The dataset's folder.
        info: What it says about itself.
        key: The camera.
        fps: The frames per second, as the frames' timestamps have them.
        thorough: Read files to their end.

    Attributes:
        key: The camera.
        fps: The frames per second.
        names: Its files, in order.
    """

    def __init__(self, root: Path, info: DatasetInfo, key: str, fps: float, thorough: bool) -> None:
        self.key, self.fps = key, fps
        paths = list_files(root, f"videos/{glob.escape(key)}/*/*.mp4")
        self.names = [path.relative_to(root) for path in paths]
        self._root, self._info, self._thorough = root, info, thorough
        self._problems: dict[Path, str | None] = {}
        self._sealed: set[Path] = set()
        self._times: dict[Path, np.ndarray] = {}

    def place(self, row: Row) -> Place | None:
        """Where an episode's row says that its pictures are; None where it does not."""
        if f"videos/{self.key}/file_index" not in row:
            return None
        start, end = (float(row[f"videos/{self.key}/{edge}_timestamp"]) for edge in ("from", "to"))
        return Place(video_file(self._info, self.key, row), start, end)

    def row(self, place: Place) -> Row:
        """The part of a row that says where pictures are."""
        values = (*(numbers(place.name) or (0, 0)), place.start, place.end)
        return {f"videos/{self.key}/{what}": value for what, value in zip(PLACE, values, strict=True)}

    def problem(self, name: Path) -> str | None:
        """What is wrong with a file as a whole.

        Raises:
            OSError: It cannot be read now; so do the other methods.
        """
        if name not in self._problems:
            with naming(self._root / name):
                self._problems[name] = self._find_problem(name)
        return self._problems[name]

    def shows(self, name: Path, start: float, length: int, certainly: bool = False) -> bool:
        """Whether a file has a picture for each frame of an episode that begins at `start` [s].

        Args:
            name: The file.
            start: When the episode begins in it [s].
            length: The episode's frames.
            certainly: Decode it, even where its checksum, or a less thorough check, makes that unnecessary.
        """
        if self.problem(name):
            return False
        if not certainly and (name in self._sealed or not self._thorough):
            return True
        times = self.times(name, also_sealed=certainly)
        if len(times) == 0:
            return False
        wanted = start + np.arange(length) / self.fps
        after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
        before = np.maximum(after - 1, 0)
        return bool((np.minimum(abs(times[after] - wanted), abs(times[before] - wanted)) < TOLERANCE).all())

    def times(self, name: Path, also_sealed: bool = True) -> np.ndarray:
        """When the pictures of a file are shown [s], (n,); all others that will be asked for are decoded in one go."""
        if name not in self._times and not self.problem(name):
            sound = [other for other in self.names if not self.problem(other)]
            names = {name, *(other for other in sound if also_sealed or other not in self._sealed)}
            for other, answer in picture_times(names - self._times.keys(), self._root).items():
                self._times[other] = np.array([] if isinstance(answer, str) else answer)
                if isinstance(answer, str):
                    self._problems[other] = f"cannot be decoded: {answer}"
        return self._times.get(name, np.empty(0))

    def _find_problem(self, name: Path) -> str | None:
        if not is_listed(self._root, name):
            return "is missing"
        problem = _cut_off(self._root / name)
        if problem or not self._thorough:
            return problem
        intact = is_intact(self._root / name)
        if intact:
            self._sealed.add(name)
        return "is not what was recorded: its checksum differs" if intact is False else None


def numbers(name: Path) -> tuple[int, int] | None:
    """The chunk and the number of a file that is named as LeRobot names them."""
    found = [re.search(r"-(\d+)$", part) for part in name.with_suffix("").parts[-2:]]
    return (int(found[0][1]), int(found[1][1])) if len(found) == 2 and found[0] and found[1] else None


def video_file(info: DatasetInfo, key: str, row: Row) -> Path:
    """The file in which an episode's row says that a camera's pictures are, relative to the dataset's folder."""
    chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
    return Path(str(info.video_path).format(video_key=key, chunk_index=int(chunk), file_index=int(file)))


def _cut_off(path: Path) -> str | None:
    """Whether the boxes that an mp4 file is made of are all there; this takes no time."""
    size, at, kinds = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            head = file.read(2 * _BOX_HEADER)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            kinds.add(head[4:8])
            if length < _BOX_HEADER or at + length > size:
                return "is cut off"
            at += length
    return None if b"moov" in kinds else "is cut off"


def check_videos(
    report: RepairReport,
    info: DatasetInfo,
    fps: float,
    episodes: Sequence[Episode],
    rows: Mapping[int, Row],
    thorough: bool,
) -> Sequence[Episode]:
    """Finds out which episodes have lost their pictures, and where those are of episodes without a row.

    Args:
        report: Of the dataset; what is wrong is added.
        info: What it says about itself.
        fps: Its frames per second, as the frames' timestamps have them.
        episodes: All there are.
        rows: What the tables say of them, and of their videos.
        thorough: Read every video to its end; otherwise only look whether it is cut off.

    Returns:
        The episodes: those without pictures are not whole, and rows that are lost are begun with the videos' places.

    Raises:
        OSError: A video cannot be read now.
    """
    for key, feature in info.features.items():
        if feature["dtype"] == "video":
            camera = Camera(report.root, info, key, fps, thorough)
            known = [
                camera.place(episode.row if episode.run else video_places(rows.get(episode.number, {}), info))
                for episode in episodes
            ]
            episodes = _check_camera(report, camera, episodes, known, info.chunks_size)
    return episodes


def _check_camera(
    report: RepairReport, camera: Camera, episodes: Sequence[Episode], known: Sequence[Place | None], chunks_size: int
) -> list[Episode]:
    """As `check_videos`, for one camera. `known`: where the pictures of each episode are said to be."""
    found: dict[int, Place] = {}
    unclaimed: list[Path] = []
    if any(episode.run and place is None for episode, place in zip(episodes, known, strict=True)):
        found = _find_places(camera, episodes, known, chunks_size)
        unclaimed = _unclaimed(camera, [*known, *found.values()])
        found = {} if unclaimed else found  # pictures of an episode that is gone may lie between them
    checked: list[Episode] = []
    lost: dict[str, list[int]] = defaultdict(list)
    unplaced: dict[int, Collection[Path]] = {}
    for episode, said in zip(episodes, known, strict=True):
        place = found.get(episode.number, said)
        problem = _problem(camera, place, episode.run.length) if episode.run else None
        if not problem or episode.run is None:
            own = camera.row(found[episode.number]) if episode.number in found else {}
            checked.append(replace(episode, row={**episode.row, **own}))
        elif files := _may_be_in(camera, place, episode.run.length, unclaimed):
            unplaced[episode.number] = files
            checked.append(episode)
        else:
            lost[problem].append(episode.number)
            checked.append(Episode(episode.number, reason=f"its video of '{camera.key}' is lost: {problem}"))
    report.findings += [f"{problem}: {name_episodes(own)}" for problem, own in lost.items()]
    if unplaced:
        names = ", ".join(map(str, sorted({name for files in unplaced.values() for name in files})))
        report.undecided.append(
            f"meta/episodes does not say, or not rightly, where the pictures of '{camera.key}' of "
            f"{name_episodes(unplaced)} are: they may be in {names}. Put the table, or videos that are missing, back from "
            "a copy. To give these episodes up, take these files away, with whatever else is in them"
        )
    return checked


def _problem(camera: Camera, place: Place | None, length: int) -> str | None:
    if place is None:
        return f"no video of '{camera.key}' has its pictures"
    if problem := camera.problem(place.name):
        return f"{place.name} {problem}"
    if camera.shows(place.name, place.start, length):
        return None
    return f"{place.name} {camera.problem(place.name) or 'lacks some of the pictures'}"


def _may_be_in(camera: Camera, place: Place | None, length: int, unclaimed: Collection[Path]) -> Collection[Path]:
    """The files that may have an episode's pictures after all: its row does not say where they are, or says two things."""
    if place is None:
        return unclaimed
    is_wrong = abs((place.end - place.start) * camera.fps - length) > 1
    return [place.name] if is_wrong and not camera.problem(place.name) else []


def _find_places(
    camera: Camera, episodes: Sequence[Episode], known: Sequence[Place | None], chunks_size: int
) -> dict[int, Place]:
    """Finds the pictures of episodes without a row: LeRobot puts one episode behind the other until a file is full.

    So an episode's place follows from that of the one before it, if this is known: nothing may be lost between them.
    """
    found: dict[int, Place] = {}
    last: Place | None = None  # of the episode before
    for episode, place in zip(episodes, known, strict=True):
        before, last = last, place
        if place or episode.run is None or (before is None and episode.number != 0):
            continue
        for name, start in _next_places(camera, before, chunks_size):
            own = Place(name, start, start + episode.run.length / camera.fps)
            is_free = not any(
                name == other.name and start < other.end - TOLERANCE and other.start < own.end - TOLERANCE
                for other in known
                if other
            )
            if is_free and camera.shows(name, start, episode.run.length, certainly=True):
                found[episode.number] = last = own
    return found


def _next_places(camera: Camera, before: Place | None, chunks_size: int) -> list[tuple[Path, float]]:
    """Where an episode can begin: in the file of the one before, or in the next where that is full; the first in the first."""
    wanted = (0, 0)
    if before is not None:
        times = camera.times(before.name)
        if len(times) == 0 or times[-1] > before.end - TOLERANCE:
            return [(before.name, before.end)]
        chunk, file = numbers(before.name) or (0, -1)
        wanted = (chunk, file + 1) if file + 1 < chunks_size else (chunk + 1, 0)
    return [(other, 0.0) for other in camera.names if numbers(other) == wanted]


def _unclaimed(camera: Camera, known: Iterable[Place | None]) -> list[Path]:
    """The files that are whole and have more pictures than is known of where episodes are."""
    n_claimed: dict[Path, int] = defaultdict(int)
    for place in known:
        if place:
            n_claimed[place.name] += round((place.end - place.start) * camera.fps)
    return [name for name in camera.names if len(camera.times(name)) > n_claimed[name]]
