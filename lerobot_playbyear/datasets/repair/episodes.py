"""The episodes of a dataset: what the tables in `meta/` say of them, held against the frames that are there."""

import contextlib
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, DatasetInfo

from lerobot_playbyear.datasets.parquet_files import READ_ERRORS, ParquetDamageError, open_checked, read_table
from lerobot_playbyear.datasets.repair.frames import Run

Row = dict[str, Any]
"""An episode's row in `meta/episodes`."""

_PARTIAL = "is partial"


def read_rows(root: Path, findings: list[str]) -> dict[int, Row]:
    """The rows of all tables of episodes that can be read, by the episode's number."""
    rows: dict[int, Row] = {}
    for path in sorted((root / EPISODES_DIR).glob("*/*.parquet")):
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
                    with contextlib.suppress(*READ_ERRORS):
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
            places = {key: value for key, value in rows.get(episode, {}).items() if key.startswith("videos/")}
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


def read_tasks(root: Path, rows: dict[int, Row], runs: dict[int, Run], findings: list[str]) -> pd.DataFrame:
    """The texts of the tasks, as LeRobot keeps them; where they are lost or wrong, from the rows of the episodes."""
    if not runs and not (root / DEFAULT_TASKS_PATH).exists():
        return pd.DataFrame({"task_index": []}, index=pd.Index([], name="task"))
    votes: dict[int, Counter[str]] = defaultdict(Counter)
    for episode, run in runs.items():
        texts = rows.get(episode, {}).get("tasks")
        if isinstance(texts, list) and len(texts) == 1 and len(run.tasks) == 1:
            votes[run.tasks[0]][str(texts[0])] += 1
    known: dict[int, str] = {}
    try:
        table = pd.read_parquet(root / DEFAULT_TASKS_PATH)
        known = {int(number): str(text) for text, number in zip(table.index, table["task_index"], strict=True)}
    except READ_ERRORS as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
        findings.append(f"{DEFAULT_TASKS_PATH} {reason}")
    needed = {task for run in runs.values() for task in run.tasks}
    for number in sorted(needed | set(votes)):
        text = votes[number].most_common(1)[0][0] if votes[number] else known.get(number)
        if text is None or text in (known.get(other) for other in known if other != number):
            text = known.get(number) or _by_elimination(number, rows, runs, known) or f"unknown task {number}"
        if number in known and not _is_misread(known[number], text):
            text = known[number]  # somebody gave the task another name
        elif number in known and known[number] != text:
            findings.append(f"{DEFAULT_TASKS_PATH}: task {number} read {known[number]!r}; the episodes say {text!r}")
        elif number not in known and text == f"unknown task {number}":
            findings.append(f"{DEFAULT_TASKS_PATH}: the text of task {number} is lost; it now reads {text!r}")
        known[number] = text
    numbers = sorted(known)
    if numbers != list(range(len(numbers))):  # LeRobot finds a task by its place
        numbers = list(range(max(numbers, default=-1) + 1))
        known = {number: known.get(number, f"unknown task {number}") for number in numbers}
    texts = pd.Index([known[number] for number in numbers], name="task")
    return pd.DataFrame({"task_index": numbers}, index=texts)


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


def _is_misread(one: str, other: str) -> bool:
    """Whether two texts differ in no more than one character, as a flipped bit makes them."""
    return len(one) == len(other) and sum(a != b for a, b in zip(one, other, strict=True)) <= 1


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
    for column in row:
        if column.startswith("stats/"):
            statistics[column.rpartition("/")[0]].add(column.rpartition("/")[2])
    if len({frozenset(names) for names in statistics.values()}) > 1:
        return "parts of its statistics are missing"
    for key, feature in info.features.items():
        if feature["dtype"] == "video" and not all(
            isinstance(row.get(f"videos/{key}/{name}"), int | float)
            for name in ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
        ):
            return f"it does not say where the video of '{key}' is"
    return None


def _by_elimination(number: int, rows: dict[int, Row], runs: dict[int, Run], known: dict[int, str]) -> str | None:
    """The one text of an episode with this task that no other of its tasks has."""
    for episode, run in runs.items():
        if number in run.tasks:
            others = {known.get(task) for task in run.tasks if task != number}
            texts = [text for text in rows.get(episode, {}).get("tasks") or [] if text not in others]
            if len(texts) == 1 and None not in others:
                return str(texts[0])
    return None
