"""The video files of one camera: whether they are whole, and which pictures they have."""

import glob
import re
from pathlib import Path

import numpy as np
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.files import is_listed, list_files, naming
from lerobot_playbyear.datasets.repair.episode_tables import PLACE, Row
from lerobot_playbyear.datasets.repair.video_times import picture_times
from lerobot_playbyear.datasets.video_seal import is_intact

TOLERANCE = 1e-4  # seconds, LeRobot's own
_BOX_HEADER = 8


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

    def has_place(self, row: Row) -> bool:
        """Whether a row says where the episode's pictures are."""
        return f"videos/{self.key}/file_index" in row

    def name(self, row: Row) -> Path:
        """The file in which an episode's row says that its pictures are."""
        return video_file(self._info, self.key, row)

    def span(self, row: Row) -> tuple[float, float]:
        """From when to when in that file [s]."""
        return float(row[f"videos/{self.key}/from_timestamp"]), float(row[f"videos/{self.key}/to_timestamp"])

    def place(self, name: Path, start: float, length: int) -> Row:
        """The part of a row that says where so many pictures are."""
        values = (*(numbers(name) or (0, 0)), start, start + length / self.fps)
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
