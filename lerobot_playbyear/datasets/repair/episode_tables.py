"""The tables in `meta/episodes`: the rows that can be read, and what they say of an episode's frames and videos."""

import contextlib
import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.utils import EPISODES_DIR, DatasetInfo

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, parsing, read_table
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.report import RepairReport

Row = Mapping[str, Any]
"""An episode's row in `meta/episodes`."""

PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
"""Of an episode in a video."""

_PARTIAL = "is partial"


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


def is_partial(row: Row) -> bool:
    """Whether parts of a row could not be read."""
    return _PARTIAL in row


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
