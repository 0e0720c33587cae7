"""The episodes of a dataset: what the tables in `meta/` say of them, held against the frames that are there."""

import contextlib
import math
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.utils import EPISODES_DIR, DatasetInfo

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, parsing, read_table
from lerobot_playbyear.datasets.repair.frames import Run

Row = dict[str, Any]
"""An episode's row in `meta/episodes`."""

_PARTIAL = "is partial"
_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")  # of an episode in a video


def read_rows(root: Path, findings: list[str]) -> dict[int, Row]:
    """The rows of all tables of episodes that can be read, by the episode's number.

    Raises:
        OSError: A table cannot be read now.
    """
    rows: dict[int, Row] = {}
    for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
        name = path.relative_to(root)
        try:
            found = read_table(path).to_pylist()
        except ParquetDamageError as error:
            findings.append(f"{name} cannot be read: {error}")
            found = _readable_parts(path)
        for row in found:
            number = row.get("episode_index")
            if not isinstance(number, int):
                findings.append(f"{name} has a row that names no episode")
            elif number in rows:
                findings.append(f"{name} names episode {number} a second time")
            else:
                rows[number] = row
    return rows


def _readable_parts(path: Path) -> list[Row]:
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


def plausible(rows: dict[int, Row], runs: list[Run], findings: list[str]) -> tuple[dict[int, Row], list[Run]]:
    """Leaves out rows and frames whose episode's number cannot be: a flipped bit makes it astronomical."""
    limit = 1000 + 10 * (len(rows) + len(runs))
    named = sorted({*rows, *(run.episode for run in runs)})
    findings += [f"there is no episode {number}, though a row names it" for number in named if not 0 <= number < limit]
    kept = {number: row for number, row in rows.items() if 0 <= number < limit}
    return kept, [run for run in runs if 0 <= run.episode < limit]


def choose_runs(runs: Iterable[Run], rows: dict[int, Row], reasons: dict[int, str]) -> dict[int, Run]:
    """The rows of each complete episode.

    Args:
        runs: All rows that can be read.
        rows: What the tables of episodes say.
        reasons: Gets, for each episode that is not complete, why.
    """
    of_episode: dict[int, list[Run]] = defaultdict(list)
    for run in runs:
        of_episode[run.episode].append(run)
    chosen: dict[int, Run] = {}
    for episode in sorted({*of_episode, *rows}):
        candidates = of_episode.get(episode, [])
        wanted = rows.get(episode, {}).get("length")
        whole = [run for run in candidates if run.first_frame == 0 and wanted in (None, run.length)]
        sound = [run for run in whole if run.damage is None]
        if sound:
            chosen[episode] = sound[0]
        elif whole:
            reasons[episode] = str(whole[0].damage)
        elif candidates and wanted is None:
            reasons[episode] = "its first frames are lost"
        elif candidates:
            reasons[episode] = f"{sum(run.length for run in candidates)} of its {wanted} frames are left"
        else:
            reasons[episode] = "its frames are lost"
    return chosen


def trusted_rows(rows: dict[int, Row], runs: dict[int, Run], info: DatasetInfo, findings: list[str]) -> dict[int, Row]:
    """The rows that agree with the frames; of the others, which are made anew, what is known of their videos."""
    trusted: dict[int, Row] = {}
    missing = []
    for episode, run in runs.items():
        if episode not in rows or _PARTIAL in rows[episode]:
            places = _video_places(rows.get(episode, {}), info)
            if places:
                trusted[episode] = places
            missing.append(episode)
            continue
        problem = _contradiction(rows[episode], run, info)
        if problem:
            findings.append(f"meta/episodes: the row of episode {episode} was wrong: {problem}")
        else:
            trusted[episode] = rows[episode]
    if missing:
        findings.append(f"meta/episodes: the rows of {name_episodes(missing)} were lost")
    return trusted


def name_episodes(numbers: Iterable[int]) -> str:
    """`episode 3`, or `episodes 3, 5 to 9 and 12`."""
    spans: list[list[int]] = []
    for number in sorted(numbers):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    parts = [str(first) if first == last else f"{first} to {last}" for first, last in spans]
    listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"episode{'s' if len(spans) > 1 or spans[0][0] != spans[0][1] else ''} {listed}"


def _contradiction(row: Row, run: Run, info: DatasetInfo) -> str | None:
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
    places = _video_places(row, info)
    for key, feature in info.features.items():
        if feature["dtype"] == "video" and f"videos/{key}/file_index" not in places:
            return f"it does not say where the video of '{key}' is"
    return None


def _video_places(row: Row, info: DatasetInfo) -> Row:
    """Where the row says that the episode's videos are: of each camera everything, or nothing."""
    places: Row = {}
    for key in (key for key, feature in info.features.items() if feature["dtype"] == "video"):
        found = {f"videos/{key}/{name}": row.get(f"videos/{key}/{name}") for name in _PLACE}
        own = {name: value for name, value in found.items() if isinstance(value, int | float) and 0 <= value < math.inf}
        if own.keys() == found.keys():
            places.update({name: int(value) if name.endswith("_index") else value for name, value in own.items()})
    return places


def _are_numbers(value: Any) -> bool:
    try:
        return np.array(value).dtype.kind in "fiub"
    except ValueError:  # lists of different lengths
        return False
