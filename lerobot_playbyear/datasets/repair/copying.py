"""Writes the repaired copy of a dataset: what is whole is taken over as it is, the rest is written anew."""

import contextlib
import errno
import glob
import itertools
import os
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from lerobot.datasets.io_utils import write_tasks
from lerobot.datasets.utils import (
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    EPISODES_DIR,
    INFO_PATH,
    STATS_PATH,
    DatasetInfo,
)

from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.files import fits, list_files
from lerobot_playbyear.datasets.journal import JOURNAL, LOCK, SCRATCH, STAGING
from lerobot_playbyear.datasets.parquet_files import PIECE_BYTES, ParquetDamageError, open_checked, write_tables
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.frames import DataFile, Run
from lerobot_playbyear.datasets.repair.metadata import settle_stats, write_own_info
from lerobot_playbyear.datasets.repair.replacing import MARKS
from lerobot_playbyear.datasets.repair.statistics import Frames, episode_stats
from lerobot_playbyear.datasets.repair.tasks import own_tasks
from lerobot_playbyear.datasets.settling import write_rows
from lerobot_playbyear.datasets.statistics import write_stats

_SCRATCH_NAMES = {LOCK.name, JOURNAL.name, STAGING.name, JOURNAL.with_suffix(".partial").name, *MARKS}
_SHIFTED = ("min", "max", "mean", "q01", "q10", "q50", "q90", "q99")


@dataclass
class Kept:
    """An episode that stays, or becomes, part of the dataset.

    Args:
        number: The episode's number from now on.
        first_index: The number of its first frame from now on.
        run: Where its frames are.
        row: Its row in `meta/episodes`; without a length, what is known of it, and the rest is made anew.
    """

    number: int
    first_index: int
    run: Run
    row: Row


def write_copy(
    root: Path,
    target: Path,
    info: DatasetInfo,
    tasks: pd.DataFrame,
    episodes: list[Kept],
    rows_before: list[Row],
    *,
    tables_stay: bool,
) -> list[str]:
    """Writes a whole dataset.

    Args:
        root: The damaged one.
        target: An empty folder; where the file system allows, it shares the unchanged files with `root`.
        info: What the dataset says about itself; its counts are set.
        tasks: Its tasks, as LeRobot keeps them.
        episodes: In the order of their numbers.
        rows_before: All rows of its tables of episodes, those of lost episodes as well.
        tables_stay: Nothing is wrong with these tables; they may stay if no row changes.

    Returns:
        What is other than it was, or stays behind, a line each.

    Raises:
        OSError: Something cannot be read now, or written.
    """
    notes = _take_over_rest(root, target, info)
    by_file: dict[Path, list[Kept]] = defaultdict(list)
    for kept in episodes:
        by_file[kept.run.file.name].append(kept)
    rows: list[Row] = []
    for own in by_file.values():
        rows += _write_data(root, target, info, tasks, own)
    rows.sort(key=lambda row: row["episode_index"])
    info.total_frames = sum(row["length"] for row in rows)
    info.total_tasks = len(tasks)
    (target / "meta").mkdir(exist_ok=True)
    write_own_info(root, target, info, [kept.run.episode for kept in episodes], notes)
    stats = settle_stats(root, info, rows, rows_before, notes)
    if stats is None:
        _take_over(root / STATS_PATH, target / STATS_PATH)
    else:
        write_stats(stats, target)
    _write_tasks(root, target, tasks, notes)
    if tables_stay and all("length" in kept.row and _stays(kept) for kept in episodes):
        for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
            _take_over(path, target / path.relative_to(root))
    else:
        _write_rows(root, target, rows, notes)
    return notes


def _write_tasks(root: Path, target: Path, tasks: pd.DataFrame, notes: list[str]) -> None:
    old, _ = own_tasks(root)
    if old is not None and old.equals(tasks):
        _take_over(root / DEFAULT_TASKS_PATH, target / DEFAULT_TASKS_PATH)
        return
    write_tasks(tasks, target)
    lost = "" if old is not None else "; what it held that no episode says is lost"
    notes.append(f"{DEFAULT_TASKS_PATH}: made anew from the episodes{lost}")


def _write_rows(root: Path, target: Path, rows: list[Row], notes: list[str]) -> None:
    """Writes one table of episodes, with the columns and types of those that there were."""
    kinds: dict[str, pa.DataType] = {}
    for path in list_files(root, f"{EPISODES_DIR}/*/*.parquet"):
        with contextlib.suppress(ParquetDamageError), open_checked(path) as file:
            kinds = {**{field.name: field.type for field in file.schema_arrow}, **kinds}
    columns = list(dict.fromkeys(column for row in rows for column in row))
    table = pa.table({name: _column([row.get(name) for row in rows], kinds.get(name)) for name in columns})
    write_rows(table, target / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0))
    lost = sorted(set(kinds) - set(columns)) if rows else []
    notes.append("meta/episodes: made anew, as one table" + (f" without {', '.join(lost)}" if lost else ""))


def _column(values: list, kind: pa.DataType | None) -> pa.Array:
    with contextlib.suppress(pa.ArrowException, TypeError, ValueError):
        return pa.array(values, kind)
    return pa.array(values)


def _stays(kept: Kept) -> bool:
    return kept.number == kept.run.episode and kept.first_index == kept.run.first_index


def _write_data(
    root: Path, target: Path, info: DatasetInfo, tasks: pd.DataFrame, episodes: list[Kept]
) -> Iterable[Row]:
    """Writes the episodes of one data file, and makes their rows."""
    file = episodes[0].run.file
    is_whole = (
        file.is_whole
        and all(_stays(kept) for kept in episodes)
        and sum(kept.run.length for kept in episodes) == file.n_rows
    )
    if is_whole:
        _take_over(root / file.name, target / file.name)
    else:
        tables = (_renumbered(rows, episodes[place], offset) for place, offset, rows in _read(file, episodes))
        write_tables(target / file.name, tables, file.schema)
    for kept in episodes:
        if "length" in kept.row:
            yield _moved(kept)
    for kept, frames in _frames(file, [kept for kept in episodes if "length" not in kept.row]):
        yield _new_row(root, info, tasks, kept, frames)


def _read(file: DataFile, episodes: list[Kept]) -> Iterator[tuple[int, int, pa.Table]]:
    """The rows of these episodes, in parts: the episode's place in the list, the first row's frame number, and rows.

    Raises:
        OSError: They cannot be read now, or are others than they were.
    """
    before, offset = -1, 0
    for place, rows in file.read((kept.run.start, kept.run.length) for kept in episodes):
        offset = 0 if place != before else offset
        run = episodes[place].run
        numbers = run.first_frame + offset + np.arange(len(rows))
        is_same = (column_to_numpy(rows.column("frame_index")) == numbers) & (
            column_to_numpy(rows.column("episode_index")) == run.episode
        )
        if not is_same.all():
            raise OSError(errno.EIO, f"the rows of episode {run.episode} are others than they were", str(file.name))
        yield place, offset, rows
        before, offset = place, offset + len(rows)


def _frames(file: DataFile, episodes: list[Kept]) -> Iterator[tuple[Kept, Frames]]:
    """Each episode with its frames under their new numbers: in memory, or read again and again where there are many."""
    for place, group in itertools.groupby(_read(file, episodes), key=lambda found: found[0]):
        kept, n_bytes = episodes[place], 0
        parts: list[pa.Table] = []
        for _, offset, rows in group:
            n_bytes += rows.nbytes
            if n_bytes <= PIECE_BYTES:
                parts.append(_renumbered(rows, kept, offset))
        yield kept, partial(iter, parts) if n_bytes <= PIECE_BYTES else partial(_again, file, kept)


def _again(file: DataFile, kept: Kept) -> Iterator[pa.Table]:
    return (_renumbered(rows, kept, offset) for _, offset, rows in _read(file, [kept]))


def _renumbered(table: pa.Table, kept: Kept, offset: int) -> pa.Table:
    """Some of an episode's rows, the first of which is its frame `offset`, with the numbers that they have from now on."""
    first = kept.first_index + offset
    values = {"episode_index": np.full(len(table), kept.number), "index": np.arange(first, first + len(table))}
    for name, value in values.items():
        field = table.schema.field(name)
        table = table.set_column(table.column_names.index(name), field, pa.array(value, field.type))
    return table


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


def _new_row(root: Path, info: DatasetInfo, tasks: pd.DataFrame, kept: Kept, frames: Frames) -> Row:
    names = {int(number): text for text, number in zip(tasks.index, tasks["task_index"], strict=True)}
    stats = episode_stats(root, info, kept.row, frames, kept.run.length)
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


_REMADE = (INFO_PATH, STATS_PATH, DEFAULT_TASKS_PATH, "data/*/*.parquet", f"{EPISODES_DIR}/*/*.parquet")


def _take_over_rest(root: Path, target: Path, info: DatasetInfo) -> list[str]:
    """Everything but the frames and the tables of `meta/`: videos, a card, notes, files of other tools.

    Returns:
        What stays behind.
    """
    notes: list[str] = []
    for path in sorted(root.iterdir()):
        new = target / path.name
        if path.name in ("data", "meta", SCRATCH.name) and path.is_dir():
            if path.is_symlink():
                notes.append(_unlinked(path, path.name))
                continue
            leave = _pictures_in_progress(path, info, notes) if path.name == SCRATCH.name else _ours_in(path, notes)
            shutil.copytree(path, new, symlinks=True, dirs_exist_ok=True, ignore=leave)
        elif path.is_symlink():
            new.symlink_to(path.readlink())
        elif path.is_dir():
            # Nobody changes a film in place; of a user's own files that is not known.
            copy = _take_over if path.name == "videos" else shutil.copy2
            shutil.copytree(path, new, symlinks=True, copy_function=copy)
        else:
            shutil.copy2(path, new)
    return notes


def _ours_in(folder: Path, notes: list[str]) -> Callable[[str, list[str]], set[str]]:
    """What is written in another way: the frames in `data`, and the tables in `meta`.

    So are folders for these that are links: through a copy of the link, the files behind it would be written over.
    """

    def leave(where: str, names: list[str]) -> set[str]:
        place = Path(folder.name) / Path(where).relative_to(folder)
        left = set()
        for path in (place / name for name in names):
            own = folder.parent / path
            if own.is_symlink() and own.is_dir() and fits(path, "data/*", EPISODES_DIR, f"{EPISODES_DIR}/*"):
                notes.append(_unlinked(own, path.as_posix()))
                left.add(path.name)
            elif fits(path, *_REMADE):
                left.add(path.name)
        return left

    return leave


def _unlinked(folder: Path, name: str) -> str:
    """Says that a folder takes a link's place. It may have led anywhere: what is not the dataset's stays there."""
    return (
        f"{name} was a link to {folder.readlink()}; it is now a folder, with the frames or tables of the dataset alone"
    )


def _pictures_in_progress(folder: Path, info: DatasetInfo, notes: list[str]) -> Callable[[str, list[str]], set[str]]:
    """What was only needed while an episode was written: LeRobot would take leftovers of it for the next one's."""

    def leave(where: str, names: list[str]) -> set[str]:
        if Path(where) != folder:
            return set()
        cameras = {name for name in names if name in info.features}
        notes.extend(
            f"images/{name}: pictures of an episode that was not saved stay behind"
            for name in sorted(cameras)
            if list_files(folder, f"{glob.escape(name)}/*/*")
        )
        return cameras | {name for name in names if name in _SCRATCH_NAMES}

    return leave


def _take_over(source: str | Path, target: str | Path) -> None:
    """A second name for a file that nobody changes in place, or a copy where there can be none."""
    source, target = Path(source), Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
        if source.stat().st_size != target.stat().st_size:
            raise OSError(errno.EIO, "it could not be copied as a whole", str(source)) from None
