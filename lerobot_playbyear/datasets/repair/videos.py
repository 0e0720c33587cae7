"""Whether each episode's pictures are in the videos, and where."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.camera import TOLERANCE, Camera, numbers
from lerobot_playbyear.datasets.repair.episode_tables import Row, video_places
from lerobot_playbyear.datasets.repair.episodes import Episode
from lerobot_playbyear.datasets.repair.report import RepairReport, name_episodes


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
                episode.row if episode.run else video_places(rows.get(episode.number, {}), info) for episode in episodes
            ]
            episodes = _check_camera(report, camera, episodes, known, info.chunks_size)
    return episodes


def _check_camera(
    report: RepairReport, camera: Camera, episodes: Sequence[Episode], known: Sequence[Row], chunks_size: int
) -> list[Episode]:
    """As `check_videos`, for one camera. `known`: of each episode what is said of where its pictures are."""
    places: Mapping[int, Row] = {}
    unclaimed: list[Path] = []
    if any(episode.run and not camera.has_place(row) for episode, row in zip(episodes, known, strict=True)):
        places = _find_places(camera, episodes, known, chunks_size)
        unclaimed = _unclaimed(camera, [*known, *places.values()])
        places = {} if unclaimed else places  # pictures of an episode that is gone may lie between them
    checked: list[Episode] = []
    lost: dict[str, list[int]] = defaultdict(list)
    unplaced: dict[int, Collection[Path]] = {}
    for episode, row in zip(episodes, known, strict=True):
        place = places.get(episode.number, row)
        problem = _problem(camera, place, episode.run.length) if episode.run else None
        if not problem or episode.run is None:
            checked.append(replace(episode, row={**episode.row, **places.get(episode.number, {})}))
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


def _problem(camera: Camera, row: Row, length: int) -> str | None:
    if not camera.has_place(row):
        return f"no video of '{camera.key}' has its pictures"
    name = camera.name(row)
    if problem := camera.problem(name):
        return f"{name} {problem}"
    if camera.shows(name, camera.span(row)[0], length):
        return None
    return f"{name} {camera.problem(name) or 'lacks some of the pictures'}"


def _may_be_in(camera: Camera, row: Row, length: int, unclaimed: Collection[Path]) -> Collection[Path]:
    """The files that may have an episode's pictures after all: its row does not say where they are, or says two things."""
    if not camera.has_place(row):
        return unclaimed
    name, (start, end) = camera.name(row), camera.span(row)
    is_wrong = abs((end - start) * camera.fps - length) > 1
    return [name] if is_wrong and not camera.problem(name) else []


def _find_places(
    camera: Camera, episodes: Sequence[Episode], known: Sequence[Row], chunks_size: int
) -> Mapping[int, Row]:
    """Finds the pictures of episodes without a row: LeRobot puts one episode behind the other until a file is full.

    So an episode's place follows from that of the one before it, if this is known: nothing may be lost between them.
    """
    claimed = [(camera.name(row), *camera.span(row)) for row in known if camera.has_place(row)]
    found: dict[int, Row] = {}
    before: tuple[Path, float] | None = None  # where the episode before ends
    for episode, row in zip(episodes, known, strict=True):
        if camera.has_place(row):
            before = camera.name(row), camera.span(row)[1]
            continue
        may_follow = episode.run is not None and (before is not None or episode.number == 0)
        candidates = _next_places(camera, before, chunks_size) if may_follow else []
        before = None
        for name, start in candidates:
            length = episode.run.length if episode.run else 0
            end = start + length / camera.fps
            is_free = not any(
                name == other and start < stop - TOLERANCE and first < end - TOLERANCE for other, first, stop in claimed
            )
            if is_free and camera.shows(name, start, length, certainly=True):
                found[episode.number] = camera.place(name, start, length)
                before = name, end
    return found


def _next_places(camera: Camera, before: tuple[Path, float] | None, chunks_size: int) -> list[tuple[Path, float]]:
    """Where an episode can begin: in the file of the one before, or in the next where that is full; the first in the first."""
    wanted = (0, 0)
    if before is not None:
        name, end = before
        times = camera.times(name)
        if len(times) == 0 or times[-1] > end - TOLERANCE:
            return [(name, end)]
        chunk, file = numbers(name) or (0, -1)
        wanted = (chunk, file + 1) if file + 1 < chunks_size else (chunk + 1, 0)
    return [(other, 0.0) for other in camera.names if numbers(other) == wanted]


def _unclaimed(camera: Camera, known: Iterable[Row]) -> list[Path]:
    """The files that are whole and have more pictures than is known of where episodes are."""
    n_claimed: dict[Path, int] = defaultdict(int)
    for row in known:
        if camera.has_place(row):
            start, end = camera.span(row)
            n_claimed[camera.name(row)] += round((end - start) * camera.fps)
    return [name for name in camera.names if len(camera.times(name)) > n_claimed[name]]
