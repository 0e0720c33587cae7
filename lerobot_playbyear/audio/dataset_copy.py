"""A copy of a dataset with more columns: every other file as it is."""

import json
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.io_utils import load_stats
from lerobot.utils.constants import DEFAULT_FEATURES
from tqdm import tqdm

from lerobot_playbyear.audio.lerobot_audio import AUDIO_FOLDER
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import Features, arrow_schema
from lerobot_playbyear.datasets.files import EPISODES_DIR, INFO_PATH, entries_below, fits, list_files, new_folder
from lerobot_playbyear.datasets.info import DOWNLOADED, STATS_PATH, came_from_the_hub, read_info
from lerobot_playbyear.datasets.parquet import (
    DataFile,
    ParquetDamageError,
    column_to_numpy,
    episode_bounds,
    numpy_to_column,
    read_table,
    write_rows,
    write_tables,
)
from lerobot_playbyear.datasets.pictures import is_unsaved, named_pictures
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.datasets.statistics import add_stats, stats_columns, write_stats

_SCRATCH = (".cache", ".git")  # what is in these folders is not the dataset's
_DATA, _EPISODES = "data/*/*.parquet", f"{EPISODES_DIR}/*/*.parquet"


@dataclass
class AddedColumn:
    """A feature that a copy has more.

    Args:
        feature: As LeRobot describes it.
        stats: Its statistics in each episode.
        values: Of an episode the values of all its frames: an array (n, ...), or what Arrow makes a column of.
    """

    feature: Mapping[str, Any]
    stats: Sequence[Mapping[str, np.ndarray]]
    values: Callable[[int], np.ndarray | list]


Columns = Mapping[str, AddedColumn]


def write_copy(
    root: Path, target: Path, added: Columns, removed: Collection[str] = (), notes: Features | None = None
) -> None:
    """Writes a dataset with more columns, which is there only when it is complete and on the disk itself.

    Args:
        root: The dataset, as `open_for_copy` opens it.
        target: Where; nothing is there yet.
        added: The columns, by their keys; all of the same episodes.
        removed: Features with files of sound in whose place they come; so do features of the same names.
        notes: What the `info` of other features says more.

    Raises:
        InputError: A table is damaged.
        OSError: Something cannot be read or written.
    """
    try:
        with new_folder(target) as unfinished:
            removed = [*removed, *(added.keys() & read_info(root)["features"].keys())]
            _write_files(root, unfinished, added, removed, notes or {})
    except ParquetDamageError as error:
        raise InputError(f"{error} Repair it first: {repair_command(root)}") from error


def _write_files(root: Path, target: Path, added: Columns, removed: Collection[str], notes: Features) -> None:
    info = read_info(root)
    features = {key: feature for key, feature in info["features"].items() if key not in removed}
    for key, more in notes.items():
        features[key] = {**features[key], "info": {**(features[key].get("info") or {}), **more}}
    own = {key: feature for key, feature in features.items() if key not in DEFAULT_FEATURES}
    info["features"] = {**own, **{key: dict(column.feature) for key, column in added.items()}, **features}
    if removed:
        info = {name: value for name, value in info.items() if name not in ("audio_path", "audio_files_size_in_mb")}
    schema = arrow_schema(info["features"])
    episodes = [dict(zip(added, own, strict=True)) for own in zip(*(a.stats for a in added.values()), strict=True)]
    named = named_pictures(root, map(DataFile, list_files(root, _DATA)), features)
    names = [path.relative_to(root) for path in entries_below(root) if path.is_file()]
    paths = [root / name for name in names if name.parts[0] not in _SCRATCH and not is_unsaved(name, named)]
    if came_from_the_hub(root):
        (target / DOWNLOADED).mkdir(parents=True)
    for path in tqdm(paths, desc="Writing", unit="file"):
        name = path.relative_to(root)
        if name.parts[0] == AUDIO_FOLDER and any(key in name.parts for key in removed):
            continue
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if fits(name, _DATA):
            _write_frames(path, target / name, schema, added, removed)
        elif fits(name, _EPISODES):
            _write_rows(path, target / name, episodes, removed)
        elif not fits(name, INFO_PATH, STATS_PATH):
            shutil.copyfile(path, target / name)  # no link: LeRobot may write into a film that is there
    known = {key: stats for key, stats in (load_stats(root) or {}).items() if key not in removed}
    write_stats({**known, **add_stats(None, episodes)}, target)
    (target / INFO_PATH).write_text(json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8")


def _write_frames(source: Path, target: Path, schema: pa.Schema, added: Columns, removed: Collection[str]) -> None:
    file = DataFile(source)
    metadata = file.schema.metadata or {}
    if b"huggingface" in metadata:
        metadata = {**metadata, **(schema.metadata or {})}
    kept = [column for column in file.schema if column.name not in removed]
    target_schema = pa.schema([*kept, *(schema.field(key) for key in added)], metadata)

    def tables() -> Iterator[pa.Table]:
        for _, table in file.row_groups():
            try:
                if isinstance(table, ParquetDamageError):
                    raise table
                for start, stop in zip(*episode_bounds(column_to_numpy(table.column("episode_index"))), strict=True):
                    frames = table.slice(start, stop - start)
                    columns = [frames.column(column.name) for column in kept]
                    columns += [_values(frames, column, schema.field(key).type) for key, column in added.items()]
                    yield pa.Table.from_arrays(columns, schema=target_schema)
            except ValueError as error:
                raise ParquetDamageError(f"{source} is damaged: {error}.") from error

    write_tables(target, tables(), target_schema)


def _values(frames: pa.Table, column: AddedColumn, kind: pa.DataType) -> pa.Array:
    """A new column of frames that follow each other in one episode."""
    episode, first = (frames.column(name)[0].as_py() for name in ("episode_index", "frame_index"))
    own = column.values(episode)[first : first + len(frames)]
    return numpy_to_column(own, kind) if isinstance(own, np.ndarray) else pa.array(own, kind)


def _write_rows(source: Path, target: Path, stats: Sequence[Mapping], removed: Collection[str]) -> None:
    rows = read_table(source)
    prefixes = tuple(f"{folder}/{key}/" for key in removed for folder in ("stats", AUDIO_FOLDER))
    rows = rows.select([name for name in rows.column_names if not name.startswith(prefixes)])
    more = [stats_columns(stats[episode]) for episode in rows.column("episode_index").to_pylist()]
    for name in more[0] if more else ():
        rows = rows.append_column(name, pa.array([own[name] for own in more]))
    write_rows(rows.replace_schema_metadata(None), target)
