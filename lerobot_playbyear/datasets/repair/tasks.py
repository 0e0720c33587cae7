"""The tasks of a dataset: the table that names them, held against what the episodes say."""

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import DEFAULT_TASKS_PATH

from lerobot_playbyear.datasets.files import read_listed
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, parsing
from lerobot_playbyear.datasets.repair.episode_tables import Row
from lerobot_playbyear.datasets.repair.episodes import Episode
from lerobot_playbyear.datasets.repair.findings import Finding, State, Thing, name_episodes


@dataclass(frozen=True)
class Tasks:
    """The tasks of a dataset.

    Args:
        table: As LeRobot keeps them: a task's number in `task_index`, its text as the index.
        is_own: Whether it is the dataset's own, which stays as it is.
        was_lost: Whether there was none that could be read.
        findings: What was found wrong.
    """

    table: pd.DataFrame
    is_own: bool
    was_lost: bool
    findings: tuple[Finding, ...]


def read_tasks(root: Path) -> pd.DataFrame | Finding:
    """The table of a dataset's tasks as it is, or what is wrong with it.

    Raises:
        OSError: It cannot be read now.
    """
    data = read_listed(root, DEFAULT_TASKS_PATH)
    if data is None:
        return Finding(Thing.TASKS, State.MISSING, f"{DEFAULT_TASKS_PATH} is missing")
    try:
        with parsing():
            return pd.read_parquet(io.BytesIO(data)).astype({"task_index": int})
    except (ParquetDamageError, TypeError) as error:
        return Finding(Thing.TASKS, State.DAMAGED, f"{DEFAULT_TASKS_PATH} cannot be read: {error}")


def settle_tasks(own: pd.DataFrame | Finding, episodes: Sequence[Episode], rows: Mapping[int, Row]) -> Tasks:
    """Holds the texts of the tasks against the rows of the episodes, from which those are taken that the table lacks.

    Only what all episodes of a task say is taken, and only of those with one task: which of several texts belongs to
    which number their rows do not say.

    Args:
        own: The table, or what is wrong with it.
        episodes: The whole ones count.
        rows: Their rows, and those of others.
    """
    whole = [episode for episode in episodes if episode.is_whole]
    if isinstance(own, Finding) and own.state is State.MISSING and not whole:  # it has only been begun
        return Tasks(pd.DataFrame({"task_index": []}, index=pd.Index([], name="task")), True, True, ())
    said = _texts(whole, rows)
    findings = [own] if isinstance(own, Finding) else []
    table = None if isinstance(own, Finding) else own
    table_has = {} if table is None else dict(zip(table["task_index"].tolist(), table.index.astype(str), strict=True))
    known = dict(table_has)
    for number in sorted({task for episode in whole if episode.run for task in episode.run.tasks}):
        texts = said.get(number, {})
        if number in table_has:
            findings += _differences(number, table_has[number], texts)
        elif len(texts) == 1 and next(iter(texts)) not in known.values():
            known[number] = next(iter(texts))
            if table is not None:
                said_now = f"the text of task {number} was missing; it is {known[number]!r}, as its episodes say"
                findings.append(_finding(State.MISSING, said_now))
        elif table is None:
            known[number] = unknown_task(number)
            others = f": the episodes name it {', '.join(map(repr, sorted(texts)))}" if texts else ""
            lost_text = f"the text of task {number} is lost{others}; it now reads {known[number]!r}"
            findings.append(_finding(State.MISSING, lost_text))
        else:
            remedy = "Put a table from a copy in its place, or correct the frames' task_index"
            findings.append(_finding(State.UNDECIDED, f"frames are of task {number}, which has no text. {remedy}"))
    if table is not None and known == table_has:
        return Tasks(table, True, False, tuple(findings))
    return Tasks(_table(table, known), False, table is None, tuple(findings))


def unknown_task(number: int) -> str:
    """What stands for a text that is lost."""
    return f"unknown task {number}"


def _texts(whole: Sequence[Episode], rows: Mapping[int, Row]) -> dict[int, dict[str, list[int]]]:
    """What the episodes with one task call it: for each task's number, each text and the episodes that say it."""
    said: dict[int, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for episode in whole:
        texts = rows.get(episode.number, {}).get("tasks")
        if episode.run and isinstance(texts, list) and len(texts) == 1 and len(episode.run.tasks) == 1:
            said[episode.run.tasks[0]][str(texts[0])].append(episode.number)
    return said


def _differences(number: int, text: str, texts: Mapping[str, list[int]]) -> list[Finding]:
    return [
        _finding(
            State.ODD,
            f"task {number} reads {text!r}; the row{'s' if len(numbers) > 1 else ''} of {name_episodes(numbers)} in "
            f"meta/episodes say{'' if len(numbers) > 1 else 's'} {other!r}. If nobody renamed it, lerobot-edit-dataset "
            "with --operation.type=modify_tasks sets the right one",
        )
        for other, numbers in texts.items()
        if other != text
    ]


def _finding(state: State, said: str) -> Finding:
    return Finding(Thing.TASKS, state, f"{DEFAULT_TASKS_PATH}: {said}")


def _table(own: pd.DataFrame | None, known: dict[int, str]) -> pd.DataFrame:
    """The table with these texts, and the columns of other tools that it had."""
    numbers = range(max(known, default=-1) + 1)  # LeRobot finds a task by its place
    texts = pd.Index([known.get(number, unknown_task(number)) for number in numbers], name="task")
    tasks = pd.DataFrame({"task_index": list(numbers)}, index=texts)
    if own is None or len(own.columns) == 1:
        return tasks
    others = own.drop_duplicates("task_index").set_index("task_index").reindex(list(numbers))
    return pd.concat([tasks, others.set_index(texts)], axis=1)[list(own.columns)]
