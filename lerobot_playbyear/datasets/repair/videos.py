"""The videos of a dataset: whether each episode's pictures are in them, and where."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.episodes import Row, name_episodes
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.video_times import picture_times

_TOLERANCE = 1e-4  # seconds, LeRobot's own
_BOX_HEADER = 8


@dataclass
class VideoFile:
    """One video file.

    Args:
        problem: Why it cannot be read; None if it can.
        times: When its pictures are shown [s], (N,); None where nobody looked.
    """

    problem: str | None = None
    times: np.ndarray | None = field(default=None, repr=False)

    def has(self, start: float, length: int, fps: int) -> bool:
        """Whether it shows a picture at every frame of an episode that begins at `start` [s]."""
        if self.problem:
            return False
        if self.times is None:
            return True
        wanted = start + np.arange(length) / fps
        if len(self.times) == 0:
            return False
        nearest = np.clip(np.searchsorted(self.times, wanted), 1, max(len(self.times) - 1, 1))
        nearest = np.minimum(nearest, len(self.times) - 1)
        before = np.maximum(nearest - 1, 0)
        distance = np.minimum(abs(self.times[nearest] - wanted), abs(self.times[before] - wanted))
        return bool((distance < _TOLERANCE).all())


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
        thorough: Decode every video to its end; otherwise only look whether it is cut off.
        reasons: Gets, for each episode that is removed, why.
        findings: Gets what was found wrong.
    """
    for key, feature in info.features.items():
        if feature["dtype"] != "video":
            continue
        files: dict[Path, VideoFile] = {}
        lost: dict[str, list[int]] = {}
        lacking = [episode for episode in runs if episode not in rows]
        if lacking:
            _place(root, info, key, runs, rows, files)
        for episode, run in list(runs.items()):
            row = rows.get(episode, {})
            if f"videos/{key}/file_index" not in row:
                reasons[episode] = f"its video of '{key}' is lost"
                del runs[episode]
                continue
            name = _name(info, key, row)
            video = _file(root / name, files, thorough)
            if not video.has(row[f"videos/{key}/from_timestamp"], run.length, info.fps):
                lost.setdefault(f"{name} {video.problem or 'ends, or has a gap, before its last picture'}", []).append(
                    episode
                )
                reasons[episode] = f"its video of '{key}' is damaged: {name} {video.problem or 'lacks pictures of it'}"
                del runs[episode]
        findings.extend(f"{problem}: {name_episodes(episodes)}" for problem, episodes in lost.items())


def _file(path: Path, files: dict[Path, VideoFile], thorough: bool) -> VideoFile:
    if path not in files:
        problem = _cut_off(path)
        files[path] = VideoFile(problem) if problem or not thorough else _decode(path)
    return files[path]


def _name(info: DatasetInfo, key: str, row: Row) -> Path:
    chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
    return Path(str(info.video_path).format(video_key=key, chunk_index=int(chunk), file_index=int(file)))


def _cut_off(path: Path) -> str | None:
    """Whether the boxes that an mp4 file is made of are all there; this takes no time."""
    try:
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
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"
    return None if b"moov" in kinds else "is cut off"


def _decode(path: Path) -> VideoFile:
    """Decodes a video to its end, or to where it breaks off."""
    try:
        return VideoFile(times=np.array(picture_times(path)))
    except ValueError as error:
        return VideoFile(f"cannot be decoded ({error})")


def _place(
    root: Path, info: DatasetInfo, key: str, runs: dict[int, Run], rows: dict[int, Row], files: dict[Path, VideoFile]
) -> None:
    """Finds the videos of episodes without a row: LeRobot puts one episode behind the other until a file is full."""
    names = sorted(path.relative_to(root) for path in (root / "videos" / key).glob("*/*.mp4"))
    at, place = 0, 0.0
    for episode in sorted(runs):
        row = rows.get(episode, {})
        if f"videos/{key}/file_index" in row:
            name = _name(info, key, row)
            at, place = names.index(name) if name in names else at, float(row[f"videos/{key}/to_timestamp"])
            continue
        while at < len(names):
            video = _file(root / names[at], files, thorough=True)
            if video.has(place, runs[episode].length, info.fps):
                break
            at, place = at + 1, 0.0
        if at == len(names):
            return
        chunk, file = (int(part.rsplit("-", 1)[-1]) for part in names[at].with_suffix("").parts[-2:])
        end = place + runs[episode].length / info.fps
        rows.setdefault(episode, {}).update(
            {
                f"videos/{key}/chunk_index": chunk,
                f"videos/{key}/file_index": file,
                f"videos/{key}/from_timestamp": place,
                f"videos/{key}/to_timestamp": end,
            }
        )
        place = end
