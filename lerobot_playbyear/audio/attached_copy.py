"""The copy of a dataset that gets sound, or pictures of it: every other file as it is."""

import itertools
import json
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_stats
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES
from tqdm import tqdm

from lerobot_playbyear.audio.attached_sound import EpisodesSound
from lerobot_playbyear.audio.audio_layout import AUDIO_FOLDER
from lerobot_playbyear.datasets.features import audio_feature
from lerobot_playbyear.datasets.info import read_info
from lerobot_playbyear.datasets.parquet import (
    ParquetDamageError,
    column_to_numpy,
    open_checked,
    read_row_groups,
    read_table,
    write_rows,
    write_tables,
)
from lerobot_playbyear.datasets.statistics import Stats, add_stats, with_stats, write_stats

_SCRATCH = ("images", ".cache", ".git")  # what is in these folders is not the dataset's


Frames = tuple[int, int, int]
"""Of one episode: its number, the first frame, and the one after the last."""


class AddedColumns(Protocol):
    """Columns of the data files that a dataset gets.

    Attributes:
        keys: Their names.
        rows_at_once: How many rows of them may be in memory together.
    """

    @property
    def keys(self) -> list[str]: ...

    @property
    def rows_at_once(self) -> int: ...

    def columns(self, runs: Sequence[Frames], schema: pa.Schema) -> list[pa.Array]:
        """For each key its values of all these frames, of the type that the schema says.

        Raises:
            ValueError: There are no such frames.
        """
        ...


@dataclass
class DatasetChange:
    """In what a copy differs from its dataset.

    Args:
        added: The features that it has more.
        stats: Their statistics, for each episode.
        columns: Those of these features that are columns of the data files.
        removed: The features that it lacks, with their columns, statistics and files of sound.
        episode_columns: Columns that `meta/episodes` has more, a value per episode.
        info: Fields of `meta/info.json` that differ; None: left out.
        notes: What the `info` of features says more.
    """

    added: dict[str, dict[str, Any]]
    stats: list[Stats]
    columns: Sequence[AddedColumns] = ()
    removed: Collection[str] = ()
    episode_columns: Mapping[str, Sequence] = field(default_factory=dict)
    info: Mapping[str, Any] = field(default_factory=dict)
    notes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def write_with_sound(
    root: Path, target: Path, sounds: Sequence[EpisodesSound], fps: int, removed: Collection[str] = ()
) -> None:
    """Writes a dataset with microphones more.

    Args:
        root: The dataset.
        target: An empty folder.
        sounds: Of all its episodes.
        fps: Its frames per second [Hz].
        removed: Features in whose place they come.

    Raises:
        ParquetDamageError: A table is damaged, or names other frames than there is sound for.
        OSError: Something cannot be read or written.
    """
    write_changed(root, target, sound_change(sounds, fps, removed))


def sound_change(sounds: Sequence[EpisodesSound], fps: int, removed: Collection[str] = ()) -> DatasetChange:
    """In what a dataset with microphones more differs; arguments as for `write_with_sound`."""
    added = {key: audio_feature(sound.sample_rate, fps) for sound in sounds for key in sound.keys}
    n_episodes = len(sounds[0].episodes)
    stats = [{key: own for sound in sounds for key, own in sound.stats(i).items()} for i in range(n_episodes)]
    info = {"audio_path": None, "audio_files_size_in_mb": None} if removed else {}
    return DatasetChange(added, stats, sounds, removed, info=info)


def write_changed(root: Path, target: Path, change: DatasetChange) -> None:
    """Writes a dataset with other features. Arguments and errors as for `write_with_sound`.

    Args:
        change: In what it differs.
    """
    info = read_info(root)
    features = _changed_features(info["features"], change)
    in_columns = {key: {**feature, "shape": tuple(feature["shape"])} for key, feature in features.items()}
    schema = get_hf_features_from_features(in_columns).arrow_schema
    paths = sorted(
        path for path in root.rglob("*") if path.is_file() and path.relative_to(root).parts[0] not in _SCRATCH
    )
    for path in tqdm(paths, desc="Writing", unit="file"):
        name = path.relative_to(root)
        if name.parts[0] == AUDIO_FOLDER and any(key in name.parts for key in change.removed):
            continue
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if name.parts[0] == "data":
            _write_data(path, target / name, schema, change)
        elif name.parts[:2] == ("meta", "episodes"):
            _write_rows(path, target / name, change)
        elif name != Path(INFO_PATH):
            shutil.copyfile(path, target / name)
    known = {key: stats for key, stats in (load_stats(root) or {}).items() if key not in change.removed}
    write_stats({**known, **add_stats(None, change.stats)}, target)
    info = {**info, "features": features, **change.info}
    kept = {name: value for name, value in info.items() if name not in change.info or value is not None}
    (target / INFO_PATH).write_text(json.dumps(kept, indent=4, ensure_ascii=False), encoding="utf-8")


def _changed_features(features: Mapping[str, dict], change: DatasetChange) -> dict[str, dict[str, Any]]:
    kept = {key: feature for key, feature in features.items() if key not in change.removed}
    for key, notes in change.notes.items():
        kept[key] = {**kept[key], "info": {**(kept[key].get("info") or {}), **notes}}
    own = {key: feature for key, feature in kept.items() if key not in DEFAULT_FEATURES}
    return {**own, **change.added, **kept}


def _write_data(source: Path, target: Path, schema: pa.Schema, change: DatasetChange) -> None:
    keys = [key for columns in change.columns for key in columns.keys]
    with open_checked(source) as file:
        metadata = file.schema_arrow.metadata or {}
        if b"huggingface" in metadata:
            metadata = {**metadata, **(schema.metadata or {})}
        kept = [column for column in file.schema_arrow if column.name not in change.removed]
        target_schema = pa.schema([*kept, *(schema.field(key) for key in keys)], metadata)

        def convert(table: pa.Table) -> pa.Table:
            try:
                return _with_columns(table.select([column.name for column in kept]), target_schema, change.columns)
            except ValueError as error:
                raise ParquetDamageError(f"{source} is damaged: {error}.") from error

        rows = min((columns.rows_at_once for columns in change.columns), default=None)
        write_tables(target, map(convert, _tables(file, source, rows)), target_schema)


def _tables(file: Any, source: Path, rows: int | None) -> Iterator[pa.Table]:
    for table in read_row_groups(file):
        if isinstance(table, ParquetDamageError):
            raise ParquetDamageError(f"{source} is damaged: {table}.")
        for start in range(0, len(table), rows or max(len(table), 1)):
            yield table.slice(start, rows)


def _with_columns(table: pa.Table, schema: pa.Schema, added: Sequence[AddedColumns]) -> pa.Table:
    runs: list[Frames] = []
    if added:
        episodes = column_to_numpy(table.column("episode_index"))
        frames = column_to_numpy(table.column("frame_index"))
        edges = np.flatnonzero((np.diff(episodes) != 0) | (np.diff(frames) != 1)) + 1
        for first, stop in itertools.pairwise([0, *edges.tolist(), len(table)]):
            runs.append((int(episodes[first]), int(frames[first]), int(frames[first]) + stop - first))
    for columns in added:
        for key, values in zip(columns.keys, columns.columns(runs, schema), strict=True):
            table = table.append_column(key, values)
    return table.replace_schema_metadata(schema.metadata)


def read_named_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """As `read_table`; the error names the file."""
    try:
        return read_table(path, columns)
    except ParquetDamageError as error:
        raise ParquetDamageError(f"{path} is damaged: {error}.") from error


def _write_rows(source: Path, target: Path, change: DatasetChange) -> None:
    rows = read_named_table(source)
    episodes = rows.column("episode_index").to_pylist()
    for episode in episodes:
        if not isinstance(episode, int) or not 0 <= episode < len(change.stats):
            raise ParquetDamageError(f"{source} is damaged: it names episode {episode} of {len(change.stats)}.")
    prefixes = tuple(f"{folder}/{key}/" for key in change.removed for folder in ("stats", AUDIO_FOLDER))
    rows = rows.select([name for name in rows.column_names if not name.startswith(prefixes)])
    rows = with_stats(rows, [change.stats[episode] for episode in episodes])
    for name, values in change.episode_columns.items():
        rows = rows.append_column(name, pa.array([values[episode] for episode in episodes]))
    write_rows(rows.replace_schema_metadata(None), target)
