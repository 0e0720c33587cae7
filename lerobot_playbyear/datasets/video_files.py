"""The films of a camera: which are whole, when their pictures are shown, and where each episode's pictures lie.

A recorder puts one episode behind the other into a film until that is full. So where an episode's pictures are, if its row
in `meta/episodes` is lost, follows from where those of the episode before it are.
"""

import contextlib
import functools
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np

from lerobot_playbyear.datasets.files import is_listed, naming
from lerobot_playbyear.datasets.info import Info, file_inside
from lerobot_playbyear.datasets.pictures import open_film

TOLERANCE_S = 1e-4
"""How far a picture's time may be from its frame's; LeRobot's own."""

_BOX_HEADER = 8
_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


class Place(NamedTuple):
    """Where an episode's pictures are: in which film, and from when to when in it [s]."""

    chunk: int
    file: int
    start: float
    end: float

    def columns(self, key: str) -> dict[str, Any]:
        """As `meta/episodes` has it for a camera."""
        return {f"videos/{key}/{name}": value for name, value in zip(_PLACE, self, strict=True)}


def place_in_row(row: Mapping[str, Any], key: str) -> Place | None:
    """Where an episode's row in `meta/episodes` says that a camera's pictures are; None where it does not."""
    values: list[Any] = [row.get(f"videos/{key}/{name}") for name in _PLACE]
    if not all(isinstance(value, int | float) and 0 <= value < math.inf for value in values):
        return None
    chunk, file, start, end = values
    return Place(int(chunk), int(file), float(start), float(end))


def film_path(root: Path, info: Info, key: str, place: Place) -> Path:
    """The film of a place.

    Raises:
        OutsideError: It lies outside the dataset's folder.
    """
    name = str(info["video_path"]).format(video_key=key, chunk_index=place.chunk, file_index=place.file)
    return file_inside(root, name)


def find_places(
    root: Path, info: Info, key: str, lengths: Sequence[int | None], said: Sequence[Place | None], thorough: bool
) -> list[Place | str | None]:
    """Finds the pictures of each episode, and whether they are all there.

    Args:
        root: The dataset's folder.
        info: What it says about itself.
        key: The camera.
        lengths: The frames of every episode, in the order of their numbers; None of one that is lost anyhow.
        said: Where its row says that its pictures are, if it does.
        thorough: Hold every film's pictures against the frames. Otherwise only those of episodes without a place, and of
            the other films whether they are cut off.

    Returns:
        For every episode its place, or why its pictures are lost; None of one that is lost anyhow and says no place.

    Raises:
        OSError: A film cannot be read now.
    """
    look = functools.cache(functools.partial(_look, root))
    film = functools.partial(film_path, root, info, key)
    found: list[Place | str | None] = []
    before: Place | None = Place(0, 0, 0.0, 0.0)
    for length, own in zip(lengths, said, strict=True):
        if length is None:
            before = own
            found.append(own)
            continue
        place, problem = own, "nothing says where"
        is_right = own is not None and abs((own.end - own.start) * info["fps"] - length) <= 1
        if not is_right:
            place = _place_after(before, look(film(before), True), length, info) if before else None
        if place:
            problem = _problem(look(film(place), thorough or not is_right), place, length, info["fps"])
            problem = problem and f"{film(place).relative_to(root)} {problem}"
        found.append(problem or place)
        before = None if problem else place
    return found


def _place_after(before: Place, times: np.ndarray | str | None, length: int, info: Info) -> Place:
    """Where the next episode's pictures are: behind the last ones, or in the next film where those end it."""
    chunk, file, start = before.chunk, before.file, before.end
    if start and not (isinstance(times, np.ndarray) and len(times) and times[-1] >= start - TOLERANCE_S):
        chunk, file = (chunk, file + 1) if file + 1 < info["chunks_size"] else (chunk + 1, 0)
        start = 0.0
    return Place(chunk, file, start, start + length / info["fps"])


def _problem(times: np.ndarray | str | None, place: Place, length: int, fps: float) -> str:
    """What is wrong with the film of a place, or that it lacks pictures of these frames; empty where nothing is."""
    if times is None or isinstance(times, str):
        return times or ""
    wanted = place.start + np.arange(length) / fps
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    near = times.take([after - 1, after], mode="clip") if len(times) else np.full((2, 1), np.inf)
    is_there = np.abs(near - wanted).min(axis=0).max() < TOLERANCE_S + np.spacing(np.float32(place.end))
    return "" if is_there else "lacks some of the pictures"


def _look(root: Path, path: Path, closely: bool) -> np.ndarray | str | None:
    """When a film's pictures are shown, or what is wrong with it; None of one that is whole, unless it is looked at closely."""
    with naming(path):
        if not is_listed(root, path.relative_to(root)):
            return "is missing"
        if _is_cut_off(path):
            return "is cut off"
        try:
            return picture_times(path) if closely else None
        except av.FFmpegError as error:
            return f"is not a video that can be read: {error}"


def picture_times(path: Path) -> np.ndarray:
    """When the pictures of a film that can be decoded are shown [s], (n,) in order.

    Raises:
        av.FFmpegError: It is no film.
        OSError: It cannot be read now.
    """
    times: list[float] = []
    with _Remembering(path) as file:
        try:
            with open_film(file) as container:
                for packet in container.demux(container.streams.video[0]):
                    pictures: list[Any] = []
                    with contextlib.suppress(av.FFmpegError):  # what it held is missing from the times
                        pictures = packet.decode()
                    times += [each.time for each in pictures if each.time is not None and not each.is_corrupt]
        finally:
            if file.problem is not None:
                raise file.problem
    return np.sort(times)


class _Remembering(io.FileIO):
    """A file that remembers that it could not be read: FFmpeg takes some errors for the film's end."""

    problem: OSError | None = None

    def read(self, size: int | None = -1, /) -> bytes:
        try:
            return super().read(size if size is not None else -1) or b""
        except OSError as error:
            self.problem = error
            raise


def _is_cut_off(path: Path) -> bool:
    """Whether not all boxes that an mp4 file is made of are there; this takes no time."""
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
                return True
            at += length
    return b"moov" not in kinds
