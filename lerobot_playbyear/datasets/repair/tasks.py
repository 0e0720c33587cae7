"""The tasks of a dataset: the table that names them, held against what the episodes say."""

import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd
from lerobot.datasets.utils import DEFAULT_TASKS_PATH

from lerobot_playbyear.datasets.files import read_listed
from lerobot_playbyear.datasets.parquet import ParquetDamageError, parsing
from lerobot_playbyear.datasets.repair.episodes import Episode, Row
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.report import RepairReport, name_episodes


@dataclass(frozen=True)
class Tasks:
    """The tasks of a dataset.

    Args:
        table: As LeRobot keeps them: a task's number in `task_index`, its text as the index.
        note: What is said of it where it is made anew; None: it is the dataset's own, which stays as it is.
    """

    table: pd.DataFrame
    note: str | None


def settle_tasks(report: RepairReport, episodes: Sequence[Episode], rows: Mapping[int, Row]) -> Tasks:
    """Reads the table of tasks, and holds its texts against the rows of the episodes.

    From these the texts are taken that the table lacks: only what all episodes of a task say, and only of those with one
    task. Which of several texts belongs to which number their rows do not say.

    Args:
        report: Of the dataset; what is wrong is added.
        episodes: The whole ones count.
        rows: Their rows, and those of others.

    Raises:
        OSError: The table cannot be read now.
    """
    runs = {episode.number: episode.run for episode in episodes if episode.run}
    data = read_listed(report.root, DEFAULT_TASKS_PATH)
    if data is None and not runs:  # it has only been begun
        return Tasks(pd.DataFrame({"task_index": []}, index=pd.Index([], name="task")), None)
    said = _texts(runs, rows)
    table = None
    if data is None:
        report.findings.append(f"{DEFAULT_TASKS_PATH} is missing")
    else:
        try:
            with parsing():
                table = pd.read_parquet(io.BytesIO(data)).astype({"task_index": int})
        except (ParquetDamageError, TypeError) as error:
            report.findings.append(f"{DEFAULT_TASKS_PATH} cannot be read: {error}")
    table_has = {} if table is None else dict(zip(table["task_index"].tolist(), table.index.astype(str), strict=True))
    known = dict(table_has)
    for number in sorted({task for run in runs.values() for task in run.tasks}):
        texts = said.get(number, {})
        if number in table_has:
            report.odd += _differences(number, table_has[number], texts)
        elif len(texts) == 1 and next(iter(texts)) not in known.values():
            known[number] = next(iter(texts))
            if table is not None:
                report.findings.append(
                    f"{DEFAULT_TASKS_PATH}: the text of task {number} was missing; it is {known[number]!r}, as its episodes "
                    "say"
                )
        elif table is None:
            known[number] = unknown_task(number)
            others = f": the episodes name it {', '.join(map(repr, sorted(texts)))}" if texts else ""
            report.findings.append(
                f"{DEFAULT_TASKS_PATH}: the text of task {number} is lost{others}; it now reads {known[number]!r}"
            )
        else:
            report.undecided.append(
                f"{DEFAULT_TASKS_PATH}: frames are of task {number}, which has no text. Put a table from a copy in its "
                "place, or correct the frames' task_index"
            )
    if table is not None and known == table_has:
        return Tasks(table, None)
    lost = "; what it held that no episode says is lost" if table is None else ""
    return Tasks(_table(table, known), f"{DEFAULT_TASKS_PATH}: made anew from the episodes{lost}")


def unknown_task(number: int) -> str:
    """What stands for a text that is lost."""
    return f"unknown task {number}"


def _texts(runs: Mapping[int, Run], rows: Mapping[int, Row]) -> dict[int, dict[str, list[int]]]:
    """What the episodes with one task call it: for each task's number, each text and the episodes that say it."""
    said: dict[int, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for number, run in runs.items():
        texts = rows.get(number, {}).get("tasks")
        if isinstance(texts, list) and len(texts) == len(run.tasks) == 1:
            said[run.tasks[0]][str(texts[0])].append(number)
    return said


def _differences(number: int, text: str, texts: Mapping[str, list[int]]) -> list[str]:
    return [
        f"{DEFAULT_TASKS_PATH}: task {number} reads {text!r}; the row{'s' if len(numbers) > 1 else ''} of "
        f"{name_episodes(numbers)} in meta/episodes say{'' if len(numbers) > 1 else 's'} {other!r}. If nobody renamed it, "
        "lerobot-edit-dataset with --operation.type=modify_tasks sets the right one"
        for other, numbers in texts.items()
        if other != text
    ]


def _table(own: pd.DataFrame | None, known: dict[int, str]) -> pd.DataFrame:
    """The table with these texts, and the columns of other tools that it had."""
    numbers = range(max(known, default=-1) + 1)  # LeRobot finds a task by its place
    texts = pd.Index([known.get(number, unknown_task(number)) for number in numbers], name="task")
    tasks = pd.DataFrame({"task_index": list(numbers)}, index=texts)
    if own is None or len(own.columns) == 1:
        return tasks
    others = own.drop_duplicates("task_index").set_index("task_index").reindex(list(numbers))
    return pd.concat([tasks, others.set_index(texts)], axis=1)[list(own.columns)]
