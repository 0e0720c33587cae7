"""The videos of a dataset: whether each episode's pictures are in them, and where."""

import glob
from pathlib import Path

import numpy as np
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.files import is_listed, list_files, naming
from lerobot_playbyear.datasets.repair.episodes import Row, name_episodes
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.video_times import picture_times
from lerobot_playbyear.datasets.video_seal import is_intact

_TOLERANCE = 1e-4  # seconds, LeRobot's own
_BOX_HEADER = 8


def check_videos(
    root: Path,
    info: DatasetInfo,
    runs: dict[int, Run],
    rows: dict[int, Row],
    thorough: bool,
    reasons: dict[int, str],
    findings: list[str],
) -> None:
    """Takes away the episodes whose pictures are lost, and finds the pictures of those without a row.

    Args:
        root: The dataset's folder.
        info: What it says about itself.
        runs: The episodes whose frames are complete; those without pictures are removed.
        rows: Their rows; those that are missing are begun, with the place of the videos.
        thorough: Read every video to its end; otherwise only look whether it is cut off.
        reasons: Gets, for each episode that is removed, why.
        findings: Gets what was found wrong.

    Raises:
        OSError: A video cannot be read now.
    """
    for key, feature in info.features.items():
        if feature["dtype"] != "video":
            continue
        camera = _Camera(root, info, key, thorough)
        if any(f"videos/{key}/file_index" not in rows.get(episode, {}) for episode in runs):
            _place(camera, runs, rows)
        lost: dict[str, list[int]] = {}
        for episode, run in list(runs.items()):
            problem = _problem(camera, rows.get(episode, {}), run.length)
            if problem:
                lost.setdefault(problem, []).append(episode)
                reasons[episode] = f"its video of '{key}' is lost: {problem}"
                del runs[episode]
        findings.extend(f"{problem}: {name_episodes(episodes)}" for problem, episodes in lost.items())


class _Camera:
    """The video files of one camera.

    Args:
        root: The dataset's folder.
        info: What it says about itself.
        key: The camera.
        thorough: Read files to their end.
    """

    def __init__(self, root: Path, info: DatasetInfo, key: str, thorough: bool) -> None:
        self.key, self.fps = key, info.fps
        paths = list_files(root, f"videos/{glob.escape(key)}/*/*.mp4")
        self.names = [path.relative_to(root) for path in paths]
        self._root, self._info, self._thorough = root, info, thorough
        self._problems: dict[Path, str | None] = {}
        self._sealed: set[Path] = set()
        self._times: dict[Path, np.ndarray] = {}

    def name(self, row: Row) -> Path:
        """The file in which an episode's row says that its pictures are."""
        return video_file(self._info, self.key, row)

    def problem(self, name: Path) -> str | None:
        """What is wrong with a file as a whole."""
        if name not in self._problems:
            with naming(self._root / name):
                self._problems[name] = self._find_problem(name)
        return self._problems[name]

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
        times = self._picture_times(name, also_sealed=certainly)
        if self.problem(name) or len(times) == 0:
            return False
        wanted = start + np.arange(length) / self._info.fps
        after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
        before = np.maximum(after - 1, 0)
        return bool((np.minimum(abs(times[after] - wanted), abs(times[before] - wanted)) < _TOLERANCE).all())

    def _picture_times(self, name: Path, also_sealed: bool) -> np.ndarray:
        """Of one file; all others that will be asked for are decoded in one go."""
        if name not in self._times:
            sound = [other for other in self.names if not self.problem(other)]
            names = {name, *(other for other in sound if also_sealed or other not in self._sealed)}
            for other, answer in picture_times(names, self._root).items():
                self._times[other] = np.array([] if isinstance(answer, str) else answer)
                if isinstance(answer, str):
                    self._problems[other] = f"cannot be decoded: {answer}"
        return self._times[name]


def video_file(info: DatasetInfo, key: str, row: Row) -> Path:
    """The file in which an episode's row says that a camera's pictures are, relative to the dataset's folder."""
    chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
    return Path(str(info.video_path).format(video_key=key, chunk_index=int(chunk), file_index=int(file)))


def _problem(camera: _Camera, row: Row, length: int) -> str | None:
    if f"videos/{camera.key}/file_index" not in row:
        return f"no video of '{camera.key}' has its pictures"
    name = camera.name(row)
    if problem := camera.problem(name):
        return f"{name} {problem}"
    if camera.shows(name, row[f"videos/{camera.key}/from_timestamp"], length):
        return None
    return f"{name} {camera.problem(name) or 'lacks some of the pictures'}"


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


def _place(camera: _Camera, runs: dict[int, Run], rows: dict[int, Row]) -> None:
    """Finds the pictures of episodes without a row: LeRobot puts one episode behind the other until a file is full."""
    key, at, start = camera.key, 0, 0.0
    for episode in sorted(runs):
        row = rows.get(episode, {})
        if f"videos/{key}/file_index" in row:
            name = camera.name(row)
            at = camera.names.index(name) if name in camera.names else at
            start = float(row[f"videos/{key}/to_timestamp"])
            continue
        length = runs[episode].length
        while at < len(camera.names) and not camera.shows(camera.names[at], start, length, certainly=True):
            at, start = at + 1, 0.0
        if at == len(camera.names):
            return
        end = start + length / camera.fps
        chunk, file = (int(part.rsplit("-", 1)[-1]) for part in camera.names[at].with_suffix("").parts[-2:])
        place = {"chunk_index": chunk, "file_index": file, "from_timestamp": start, "to_timestamp": end}
        rows.setdefault(episode, {}).update({f"videos/{key}/{what}": value for what, value in place.items()})
        start = end
