"""The tasks of a dataset: the table that names them, held against what the episodes say."""

import io
from collections import Counter, defaultdict
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import DEFAULT_TASKS_PATH

from lerobot_playbyear.datasets.files import is_listed, naming
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, parsing
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.frames import Run


def read_tasks(root: Path, rows: dict[int, Row], runs: dict[int, Run], findings: list[str]) -> pd.DataFrame:
    """The texts of the tasks, as LeRobot keeps them; where they are lost or wrong, from the rows of the episodes.

    Raises:
        OSError: The table cannot be read now.
    """
    if not runs and not is_listed(root, DEFAULT_TASKS_PATH):
        return pd.DataFrame({"task_index": []}, index=pd.Index([], name="task"))
    votes: dict[int, Counter[str]] = defaultdict(Counter)
    for episode, run in runs.items():
        texts = rows.get(episode, {}).get("tasks")
        if isinstance(texts, list) and len(texts) == 1 and len(run.tasks) == 1:
            votes[run.tasks[0]][str(texts[0])] += 1
    own, problem = own_tasks(root)
    known = {} if own is None else dict(zip(own["task_index"].tolist(), own.index.astype(str), strict=True))
    if problem:
        findings.append(f"{DEFAULT_TASKS_PATH} {problem}")
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
    tasks = pd.DataFrame({"task_index": numbers}, index=texts)
    if own is None or len(own.columns) == 1:
        return tasks
    others = own.drop_duplicates("task_index").set_index("task_index").reindex(numbers)
    return pd.concat([tasks, others.set_index(texts)], axis=1)[list(own.columns)]


def own_tasks(root: Path) -> tuple[pd.DataFrame | None, str | None]:
    """The table of a dataset's tasks as it is, or what is wrong with it.

    Raises:
        OSError: It cannot be read now.
    """
    if not is_listed(root, DEFAULT_TASKS_PATH):
        return None, "is missing"
    with naming(root / DEFAULT_TASKS_PATH):
        data = (root / DEFAULT_TASKS_PATH).read_bytes()
    try:
        with parsing():
            table = pd.read_parquet(io.BytesIO(data))
            return table.astype({"task_index": int}), None
    except ParquetDamageError as error:
        return None, f"cannot be read: {error}"
    except TypeError as error:
        return None, f"cannot be read: {error}"


def _is_misread(one: str, other: str) -> bool:
    """Whether two texts differ in no more than one character, as a flipped bit makes them."""
    return len(one) == len(other) and sum(a != b for a, b in zip(one, other, strict=True)) <= 1


def _by_elimination(number: int, rows: dict[int, Row], runs: dict[int, Run], known: dict[int, str]) -> str | None:
    """The one text of an episode with this task that no other of its tasks has."""
    for episode, run in runs.items():
        if number in run.tasks:
            others = {known.get(task) for task in run.tasks if task != number}
            texts = [text for text in rows.get(episode, {}).get("tasks") or [] if text not in others]
            if len(texts) == 1 and None not in others:
                return str(texts[0])
    return None
