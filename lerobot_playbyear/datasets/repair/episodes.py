"""The episodes of a dataset: the rows of its tables held against the frames that are there. Nothing is read here."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.episode_tables import (
    Row,
    contradiction,
    is_partial,
    stated_lengths,
    video_places,
)
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.report import RepairReport, name_episodes

_MOST_LOST = 10_000  # of which nothing is left, and which are named one by one


@dataclass(frozen=True)
class Episode:
    """An episode that is there, or of which something tells that it was.

    Args:
        number: Its number.
        run: Its frames, where all of it is there.
        row: Its row in `meta/episodes` where that is right; without a length, what is known of it (its videos' places).
        reason: Otherwise why not.
    """

    number: int
    run: Run | None = None
    row: Row = field(default_factory=dict)
    reason: str = ""


def match_episodes(report: RepairReport, runs: Iterable[Run], rows: Iterable[Row], info: DatasetInfo) -> list[Episode]:
    """Finds each episode's frames, and whether its row is right.

    Args:
        report: Of the dataset; what is wrong is added.
        runs: All rows of frames that can be read.
        rows: All rows of the tables of episodes that can be read.
        info: What the dataset says about itself.
    """
    runs_of: dict[int, list[Run]] = defaultdict(list)
    rows_of: dict[int, list[Row]] = defaultdict(list)
    for run in runs:
        runs_of[run.episode].append(run)
    for row in rows:
        rows_of[row["episode_index"]].append(row)
    episodes: list[Episode] = []
    without_row: list[int] = []
    for number in sorted({*runs_of, *rows_of}):
        own = rows_of[number]
        episode = _choose_run(number, runs_of[number], own)
        if episode.run is not None:
            row, problem = _choose_row(episode.run, own, info)
            episode = replace(episode, row=row)
            if problem:
                report.findings.append(f"meta/episodes: the row of episode {number} was wrong: {problem}")
            elif "length" not in row:
                without_row.append(number)
        episodes.append(episode)
    if without_row:
        report.findings.append(f"meta/episodes: the rows of {name_episodes(without_row)} were lost")
    return episodes


def with_lost(info: DatasetInfo, episodes: Sequence[Episode]) -> list[Episode]:
    """All episodes, also those of which nothing is left but a gap in the numbers, or that they were counted."""
    count = _count(episodes)
    is_short = info.total_frames != _n_frames(episodes)
    total = info.total_episodes if is_short and count < info.total_episodes < count + _MOST_LOST else count
    known = {episode.number: episode for episode in episodes}
    return [known.get(number, Episode(number, reason="nothing is left of it")) for number in range(total)]


def check_counts(report: RepairReport, info: DatasetInfo, episodes: Sequence[Episode]) -> None:
    """Holds what `meta/info.json` counts, and the frames' numbers, against what is there."""
    count, n_frames = _count(episodes), _n_frames(episodes)
    all_whole = all(episode.run for episode in episodes)
    if info.total_episodes != count or (all_whole and info.total_frames != n_frames):
        report.findings.append(
            f"meta/info.json counts {info.total_episodes} episodes of {info.total_frames} frames in all; there are {count} "
            f"of {n_frames}"
        )
    expected = 0
    for run in (episode.run for episode in episodes if all_whole and episode.run):
        if run.first_index != expected:
            report.findings.append(f"episode {run.episode} begins with frame {run.first_index}, not {expected}")
        expected += run.length


def _count(episodes: Sequence[Episode]) -> int:
    return max((episode.number for episode in episodes), default=-1) + 1


def _n_frames(episodes: Sequence[Episode]) -> int:
    return sum(episode.run.length for episode in episodes if episode.run)


def without_impossible_numbers(
    report: RepairReport, runs: Sequence[Run], rows: Sequence[Row]
) -> tuple[list[Run], list[Row]]:
    """Leaves out what names an episode that cannot be: its number is far above the count of all there are."""
    limit = 1000 + 10 * (len(rows) + len(runs))
    said = "there is no episode {}, though a row names it"
    in_tables = {number for row in rows if not 0 <= (number := row["episode_index"]) < limit}
    in_data = {(run.episode, str(run.file.name)) for run in runs if not 0 <= run.episode < limit}
    report.findings += [said.format(number) for number in sorted(in_tables)]
    report.undecided += [
        f"{said.format(number)} in {name}. Correct the number, or take the file away with all that is in it"
        for number, name in sorted(in_data)
    ]
    return (
        [run for run in runs if 0 <= run.episode < limit],
        [row for row in rows if 0 <= row["episode_index"] < limit],
    )


def _choose_run(number: int, runs: Sequence[Run], rows: Sequence[Row]) -> Episode:
    """The rows of an episode, if it is complete."""
    lengths = {length for row in rows for length in stated_lengths(row)}
    whole = [run for run in runs if run.first_frame == 0 and (not lengths or run.length in lengths)]
    sound = [run for run in whole if run.damage is None]
    if sound:
        return Episode(number, sound[0])
    if whole:
        reason = str(whole[0].damage)
    elif runs and not lengths:
        reason = "its first frames are lost"
    elif runs:
        wanted = " or ".join(str(length) for length in sorted(lengths))
        reason = f"{sum(run.length for run in runs)} of its {wanted} frames are left"
    else:
        reason = "its frames are lost"
    return Episode(number, reason=reason)


def _choose_row(run: Run, rows: Sequence[Row], info: DatasetInfo) -> tuple[Row, str | None]:
    """The row that agrees with an episode's frames. Otherwise what is known of their videos, and what is wrong with it."""
    problem = None
    for row in rows:
        if not is_partial(row):
            contradicted = contradiction(row, run, info)
            if contradicted is None:
                return row, None
            problem = problem or contradicted
    return (video_places(rows[0], info) if rows and not problem else {}), problem
