"""Writes the repaired copy of a dataset: what is whole is taken over as it is, the rest is written anew."""

import os
import shutil
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
from lerobot.datasets.io_utils import write_info, write_tasks
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, DatasetInfo

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.parquet_files import open_checked, write_tables
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.frames import DataFile, Run
from lerobot_playbyear.datasets.repair.statistics import episode_stats
from lerobot_playbyear.datasets.settling import write_rows
from lerobot_playbyear.datasets.statistics import add_stats, row_stats, write_stats

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


def write_copy(root: Path, target: Path, info: DatasetInfo, tasks: pd.DataFrame, episodes: list[Kept]) -> None:
    """Writes a whole dataset.

    Args:
        root: The damaged one.
        target: An empty folder; where the file system allows, it shares the unchanged files with `root`.
        info: What the dataset says about itself; its counts are set.
        tasks: Its tasks, as LeRobot keeps them.
        episodes: In the order of their numbers.
    """
    _take_over_rest(root, target)
    for name in sorted({path.relative_to(root) for path in (root / "videos").rglob("*") if path.is_file()}):
        _take_over(root / name, target / name)
    by_file: dict[Path, list[Kept]] = defaultdict(list)
    for kept in episodes:
        by_file[kept.run.file.name].append(kept)
    rows: list[Row] = []
    for own in by_file.values():
        rows += _write_data(root, target, info, tasks, own)
    rows.sort(key=lambda row: row["episode_index"])
    columns = list(dict.fromkeys(column for row in rows for column in row))
    table = pa.table({column: [row.get(column) for row in rows] for column in columns})
    write_rows(table, target / DEFAULT_EPISODES_PATH.format(chunk_index=0, file_index=0))
    write_tasks(tasks, target)
    write_stats(add_stats(None, [row_stats(row) for row in rows], audio_keys(info.features)), target)
    info.total_episodes = len(rows)
    info.total_frames = sum(row["length"] for row in rows)
    info.total_tasks = len(tasks)
    info.splits = {"train": f"0:{len(rows)}"}
    write_info(info, target)


def _write_data(
    root: Path, target: Path, info: DatasetInfo, tasks: pd.DataFrame, episodes: list[Kept]
) -> Iterable[Row]:
    """Writes the episodes of one data file, and makes their rows."""
    file = episodes[0].run.file
    numbers_stay = all(
        kept.number == kept.run.episode and kept.first_index == kept.run.first_index for kept in episodes
    )
    is_whole = file.is_whole and numbers_stay and sum(kept.run.length for kept in episodes) == _n_rows(file)
    table = None if is_whole and all("length" in kept.row for kept in episodes) else file.read()
    if is_whole:
        _take_over(root / file.name, target / file.name)
    else:
        assert table is not None
        tables = [_renumbered(table.slice(kept.run.start, kept.run.length), kept) for kept in episodes]
        write_tables(target / file.name, tables, table.schema)
    for kept in episodes:
        if "length" in kept.row:
            yield _moved(kept)
        else:
            assert table is not None
            yield _new_row(root, info, tasks, kept, table.slice(kept.run.start, kept.run.length))


def _n_rows(file: DataFile) -> int:
    assert isinstance(file.source, Path)
    with open_checked(file.source) as opened:
        return opened.metadata.num_rows


def _renumbered(table: pa.Table, kept: Kept) -> pa.Table:
    values = {
        "episode_index": np.full(len(table), kept.number),
        "index": np.arange(kept.first_index, kept.first_index + len(table)),
    }
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
                row[column] = [value + shift for value in row[column]]
    return {**row, **_places(kept)}


def _new_row(root: Path, info: DatasetInfo, tasks: pd.DataFrame, kept: Kept, frames: pa.Table) -> Row:
    names = {int(number): text for text, number in zip(tasks.index, tasks["task_index"], strict=True)}
    stats = episode_stats(root, info, kept.row, _renumbered(frames, kept))
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


def _take_over_rest(root: Path, target: Path) -> None:
    """Everything that LeRobot does not know: a card, notes, other folders."""
    for path in root.iterdir():
        if path.name in ("data", "videos", "meta", "images"):
            continue
        if path.is_dir():
            shutil.copytree(path, target / path.name, symlinks=True)
        else:
            shutil.copy2(path, target / path.name, follow_symlinks=False)


def _take_over(source: Path, target: Path) -> None:
    """A second name for a file that nobody changes in place, or a copy where there can be none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
