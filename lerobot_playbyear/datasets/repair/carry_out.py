"""Carries a plan out: writes the repaired copy of a dataset, with what is whole as it is, and the rest anew."""

import contextlib
import errno
import itertools
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from lerobot.datasets.io_utils import write_json, write_tasks
from lerobot.datasets.utils import (
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    EPISODES_DIR,
    INFO_PATH,
    STATS_PATH,
)

from lerobot_playbyear.datasets.episode_clock import renumber_episode_starts
from lerobot_playbyear.datasets.files import list_files, take_over
from lerobot_playbyear.datasets.parquet import (
    PIECE_BYTES,
    ParquetDamageError,
    column_to_numpy,
    open_checked,
    with_values,
    write_tables,
)
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.frames import DataFile
from lerobot_playbyear.datasets.repair.plan import Kept, Plan
from lerobot_playbyear.datasets.repair.statistics import Frames, episode_stats, settle_stats
from lerobot_playbyear.datasets.repair.taking_over import take_over_rest
from lerobot_playbyear.datasets.settling import write_rows
from lerobot_playbyear.datasets.statistics import write_stats

_SHIFTED = ("min", "max", "mean", "q01", "q10", "q50", "q90", "q99")


def write_copy(root: Path, target: Path, plan: Plan) -> list[str]:
    """Writes a whole dataset.

    Args:
        root: The damaged one.
        target: An empty folder; where the file system allows, it shares the unchanged files with `root`.
        plan: What becomes of it.

    Returns:
        What is other than it was, or stays behind, a line each.

    Raises:
        OSError: Something cannot be read now, or written.
    """
    survey = plan.survey
    notes = [*take_over_rest(root, target, plan.info.features), *plan.notes]
    numbers = {kept.run.episode: kept.number for kept in plan.kept}
    if said := renumber_episode_starts(target, numbers):
        notes.append(said)
    by_file: dict[Path, list[Kept]] = defaultdict(list)
    for kept in plan.kept:
        by_file[kept.run.file.name].append(kept)
    rows = [row for own in by_file.values() for row in _write_data(root, target, plan, own)]
    rows.sort(key=lambda row: row["episode_index"])
    (target / "meta").mkdir(exist_ok=True)
    write_json({**survey.info_fields, **plan.info.to_dict()}, target / INFO_PATH)
    stats, changes = settle_stats(survey.stats, plan.info, rows, survey.rows)
    notes += changes
    if stats is None:
        take_over(root / STATS_PATH, target / STATS_PATH)
    else:
        write_stats(stats, target)
    if survey.tasks.note is None:
        take_over(root / DEFAULT_TASKS_PATH, target / DEFAULT_TASKS_PATH)
    else:
        write_tasks(survey.tasks.table, target)
        notes.append(survey.tasks.note)
    if plan.tables_stay:
        for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
            take_over(path, target / path.relative_to(root))
    else:
        notes.append(_write_rows(root, target, rows))
    return notes


def _write_rows(root: Path, target: Path, rows: list[Row]) -> str:
    """Writes one table of episodes, with the columns and types of those that there were. Returns what is said of it."""
    kinds: dict[str, pa.DataType] = {}
    for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
        with contextlib.suppress(ParquetDamageError), open_checked(path) as file:
            kinds = {**{field.name: field.type for field in file.schema_arrow}, **kinds}
    columns = list(dict.fromkeys(column for row in rows for column in row))
    table = pa.table({name: _column([row.get(name) for row in rows], kinds.get(name)) for name in columns})
    write_rows(table, target / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0))
    lost = sorted(set(kinds) - set(columns)) if rows else []
    return "meta/episodes: made anew, as one table" + (f" without {', '.join(lost)}" if lost else "")


def _column(values: list, kind: pa.DataType | None) -> pa.Array:
    with contextlib.suppress(pa.ArrowException, TypeError, ValueError):
        return pa.array(values, kind)
    return pa.array(values)


def _write_data(root: Path, target: Path, plan: Plan, episodes: list[Kept]) -> Iterator[Row]:
    """Writes the episodes of one data file, and makes their rows."""
    file = episodes[0].run.file
    is_whole = (
        file.is_whole
        and all(kept.frames_stay for kept in episodes)
        and sum(kept.run.length for kept in episodes) == file.n_rows
    )
    if is_whole:
        take_over(root / file.name, target / file.name)
    else:
        write_tables(target / file.name, (table for _, table in _read(file, episodes)), file.schema)
    for kept in episodes:
        if kept.has_row:
            yield _moved(kept)
    for kept, frames in _frames(file, [kept for kept in episodes if not kept.has_row]):
        yield _new_row(root, plan, kept, frames)


def _read(file: DataFile, episodes: list[Kept]) -> Iterator[tuple[Kept, pa.Table]]:
    """The rows of these episodes, in parts, under their new numbers.

    Raises:
        OSError: They cannot be read now, or are others than they were.
    """
    for place, offset, rows in file.read((kept.run.start, kept.run.length) for kept in episodes):
        kept, numbers = episodes[place], offset + np.arange(len(rows))
        is_same = (column_to_numpy(rows.column("frame_index")) == kept.run.first_frame + numbers) & (
            column_to_numpy(rows.column("episode_index")) == kept.run.episode
        )
        if not is_same.all():
            raise OSError(
                errno.EIO, f"the rows of episode {kept.run.episode} are others than they were", str(file.name)
            )
        rows = with_values(rows, "episode_index", np.full(len(rows), kept.number))
        yield kept, with_values(rows, "index", kept.first_index + numbers)


def _frames(file: DataFile, episodes: list[Kept]) -> Iterator[tuple[Kept, Frames]]:
    """Each episode with its frames under their new numbers: in memory, or read again and again where there are many."""
    of_number = {kept.number: kept for kept in episodes}
    for number, group in itertools.groupby(_read(file, episodes), key=lambda found: found[0].number):
        kept, n_bytes = of_number[number], 0
        parts: list[pa.Table] = []
        for _, rows in group:
            n_bytes += rows.nbytes
            if n_bytes <= PIECE_BYTES:
                parts.append(rows)
        yield kept, partial(iter, parts) if n_bytes <= PIECE_BYTES else partial(_again, file, kept)


def _again(file: DataFile, kept: Kept) -> Iterator[pa.Table]:
    return (rows for _, rows in _read(file, [kept]))


def _moved(kept: Kept) -> Row:
    """An episode's row under its new numbers; its statistics count them, too."""
    shifts = {
        "episode_index": kept.number - kept.run.episode,
        "index": kept.first_index - kept.run.first_index,
    }
    row = dict(kept.row)
    for key, shift in shifts.items():
        for name in _SHIFTED:
            column = f"stats/{key}/{name}"
            if shift and row.get(column) is not None:
                row[column] = (np.array(row[column]) + shift).tolist()
    return {**row, **_places(kept)}


def _new_row(root: Path, plan: Plan, kept: Kept, frames: Frames) -> Row:
    table = plan.survey.tasks.table
    names = {int(number): text for text, number in zip(table.index, table["task_index"], strict=True)}
    stats = episode_stats(root, plan.info, kept.row, frames, kept.run.length)
    return {
        "episode_index": kept.number,
        "tasks": [names[task] for task in kept.run.tasks],
        "length": kept.run.length,
        **kept.row,
        **_places(kept),
        **{f"stats/{key}/{name}": value.tolist() for key, own in stats.items() for name, value in own.items()},
    }


def _places(kept: Kept) -> Row:
    chunk, file = (int(part.rsplit("-", 1)[-1]) for part in kept.run.file.name.with_suffix("").parts[-2:])
    return {
        "episode_index": kept.number,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": kept.first_index,
        "dataset_to_index": kept.first_index + kept.run.length,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
