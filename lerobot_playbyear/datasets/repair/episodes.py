"""The episodes of a dataset: the rows of the tables in `meta/episodes`, held against the frames that are there."""

import contextlib
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.utils import EPISODES_DIR, DatasetInfo

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet import ParquetDamageError, open_checked, parsing, read_table
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.report import RepairReport, name_episodes

Row = Mapping[str, Any]
"""An episode's row in `meta/episodes`."""

PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
"""Of an episode in a video."""

_PARTIAL = "is partial"  # in a row of which parts could not be read


def read_rows(report: RepairReport) -> list[Row]:
    """The rows of all tables of episodes that can be read, in order.

    There is more than one of an episode where tables contradict each other. What is wrong is added to the report.

    Raises:
        OSError: A table cannot be read now.
    """
    rows: list[Row] = []
    named: set[int] = set()
    for path in list_files(report.root, f"{EPISODES_DIR}/*/*.parquet"):
        name = path.relative_to(report.root)
        try:
            found = read_table(path).to_pylist()
        except ParquetDamageError as error:
            report.findings.append(f"{name} cannot be read: {error}")
            found = _readable_parts(path)
        for row in found:
            number = row.get("episode_index")
            if not isinstance(number, int):
                report.findings.append(f"{name} has a row that names no episode")
                continue
            if number in named:
                report.findings.append(f"{name} names episode {number} a second time")
            named.add(number)
            rows.append(row)
    return rows


def _readable_parts(path: Path) -> list[dict[str, Any]]:
    """What can be read of a damaged table without its statistics, column by column."""
    parts: dict[str, list] = {}
    try:
        with open_checked(path) as file:
            for column in file.schema_arrow.names:
                if not column.startswith("stats/"):
                    with contextlib.suppress(ParquetDamageError), parsing(path):
                        parts[column] = file.read(columns=[column], use_threads=False).column(column).to_pylist()
    except ParquetDamageError:
        return []
    n_rows = len(parts.get("episode_index", []))
    parts = {column: values for column, values in parts.items() if len(values) == n_rows}
    return [{_PARTIAL: True} | {column: values[i] for column, values in parts.items()} for i in range(n_rows)]


def stated_lengths(row: Row) -> set[int]:
    """An episode's frames as its row counts them, in one way and the other: they differ where a number is wrong."""
    length, first, end = (row.get(name) for name in ("length", "dataset_from_index", "dataset_to_index"))
    counted = {end - first} if isinstance(first, int) and isinstance(end, int) else set()
    return counted | ({length} if isinstance(length, int) else set())


def contradiction(row: Row, run: Run, info: DatasetInfo) -> str | None:
    """What an episode's row says that its frames do not."""
    try:
        file = info.data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        span = (row["dataset_from_index"], row["dataset_to_index"])
    except (KeyError, ValueError, TypeError) as error:
        return f"{error} is missing"
    if file != run.file.name.as_posix():
        return f"its frames are in {run.file.name}, not in {file}"
    if span != (run.first_index, run.first_index + run.length):
        return f"it counted frames {span[0]} to {span[1]}; they are {run.first_index} to {run.first_index + run.length}"
    if row.get("length") != run.length:
        return f"its length was {row.get('length')}; it has {run.length} frames"
    if not isinstance(row.get("tasks"), list):
        return "its tasks are missing"
    statistics: dict[str, set[str]] = defaultdict(set)
    for column, value in row.items():
        if column.startswith("stats/") and value is not None:
            statistics[column.rpartition("/")[0]].add(column.rpartition("/")[2])
            if not _are_numbers(value):
                return f"its statistics '{column.removeprefix('stats/')}' are no numbers"
    if len({frozenset(names) for names in statistics.values()}) > 1:
        return "parts of its statistics are missing"
    places = video_places(row, info)
    for key, feature in info.features.items():
        if feature["dtype"] == "video" and f"videos/{key}/file_index" not in places:
            return f"it does not say where the video of '{key}' is"
    return None


def video_places(row: Row, info: DatasetInfo) -> Row:
    """Where the row says that the episode's videos are: of each camera everything, or nothing."""
    places: dict[str, Any] = {}
    for key in (key for key, feature in info.features.items() if feature["dtype"] == "video"):
        found = {f"videos/{key}/{name}": row.get(f"videos/{key}/{name}") for name in PLACE}
        own = {name: value for name, value in found.items() if isinstance(value, int | float) and 0 <= value < math.inf}
        if own.keys() == found.keys():
            places.update({name: int(value) if name.endswith("_index") else value for name, value in own.items()})
    return places


def _are_numbers(value: Any) -> bool:
    try:
        return np.array(value).dtype.kind in "fiub"
    except ValueError:  # lists of different lengths
        return False


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
    count = episodes[-1].number + 1 if episodes else 0
    is_short = info.total_frames != _n_frames(episodes)
    total = info.total_episodes if is_short and count < info.total_episodes < count + _MOST_LOST else count
    known = {episode.number: episode for episode in episodes}
    return [known.get(number, Episode(number, reason="nothing is left of it")) for number in range(total)]


def check_counts(report: RepairReport, info: DatasetInfo, episodes: Sequence[Episode]) -> None:
    """Holds what `meta/info.json` counts, and the frames' numbers, against what is there."""
    count, n_frames = len(episodes), _n_frames(episodes)
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
        if _PARTIAL not in row:
            contradicted = contradiction(row, run, info)
            if contradicted is None:
                return row, None
            problem = problem or contradicted
    return (video_places(rows[0], info) if rows and not problem else {}), problem
