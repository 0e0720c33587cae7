"""The copy of a dataset that gets sound: every file as it is, with a column more in its tables."""

import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_info, load_stats, write_info
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES
from tqdm import tqdm

from lerobot_playbyear.datasets.attached_sound import EpisodesSound
from lerobot_playbyear.datasets.audio_feature import audio_feature
from lerobot_playbyear.datasets.columns import column_to_numpy, numpy_to_column
from lerobot_playbyear.datasets.parquet_files import (
    ParquetDamageError,
    open_checked,
    read_row_groups,
    read_table,
    write_tables,
)
from lerobot_playbyear.datasets.settling import write_rows
from lerobot_playbyear.datasets.statistics import Stats, add_stats, with_sound_stats, write_stats

_SCRATCH = ("images", ".cache", ".git")  # what is in these folders is not the dataset's


def write_with_sound(root: Path, target: Path, sound: EpisodesSound) -> None:
    """Writes a dataset with microphones more.

    Args:
        root: The dataset.
        target: An empty folder.
        sound: Of all its episodes.

    Raises:
        ParquetDamageError: A table is damaged, or names other frames than there is sound for.
        OSError: Something cannot be read or written.
    """
    info = load_info(root)
    info.features = _with_microphones(info.features, sound, info.fps)
    schema = get_hf_features_from_features(info.features).arrow_schema
    stats = [sound.stats(episode) for episode in range(len(sound.episodes))]
    paths = sorted(
        path for path in root.rglob("*") if path.is_file() and path.relative_to(root).parts[0] not in _SCRATCH
    )
    for path in tqdm(paths, desc="Writing", unit="file"):
        name = path.relative_to(root)
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if name.parts[0] == "data":
            _write_data(path, target / name, schema, sound)
        elif name.parts[:2] == ("meta", "episodes"):
            _write_rows(path, target / name, stats)
        elif name != Path(INFO_PATH):
            shutil.copyfile(path, target / name)
    known = load_stats(root) or {}
    write_stats({**known, **add_stats(None, stats, sound.keys)}, target)
    write_info(info, target)


def _with_microphones(features: dict[str, dict], sound: EpisodesSound, fps: int) -> dict[str, dict[str, Any]]:
    own = {key: feature for key, feature in features.items() if key not in DEFAULT_FEATURES}
    return {**own, **{key: audio_feature(sound.sample_rate, fps) for key in sound.keys}, **features}


def _write_data(source: Path, target: Path, schema: pa.Schema, sound: EpisodesSound) -> None:
    with open_checked(source) as file:
        metadata = file.schema_arrow.metadata or {}
        if b"huggingface" in metadata:
            metadata = {**metadata, **(schema.metadata or {})}
        target_schema = pa.schema([*file.schema_arrow, *(schema.field(key) for key in sound.keys)], metadata)

        def add(table: pa.Table) -> pa.Table:
            try:
                return _with_columns(table, target_schema, sound)
            except ValueError as error:
                raise ParquetDamageError(f"{source} is damaged: {error}.") from error

        write_tables(target, map(add, _tables(file, source, sound.rows_at_once)), target_schema)


def _tables(file: Any, source: Path, rows: int) -> Iterator[pa.Table]:
    for table in read_row_groups(file):
        if isinstance(table, ParquetDamageError):
            raise ParquetDamageError(f"{source} is damaged: {table}.")
        for start in range(0, len(table), rows):
            yield table.slice(start, rows)


def _with_columns(table: pa.Table, schema: pa.Schema, sound: EpisodesSound) -> pa.Table:
    episodes = column_to_numpy(table.column("episode_index"))
    frames = column_to_numpy(table.column("frame_index"))
    edges = np.flatnonzero((np.diff(episodes) != 0) | (np.diff(frames) != 1)) + 1
    parts = []
    for first, stop in itertools.pairwise([0, *edges.tolist(), len(table)]):
        start = int(frames[first])
        parts.append(sound.blocks(int(episodes[first]), start, start + stop - first))
    blocks = np.concatenate(parts)
    for i, key in enumerate(sound.keys):
        table = table.append_column(key, numpy_to_column(blocks[..., i], schema.field(key).type))
    return table.replace_schema_metadata(schema.metadata)


def read_named_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """As `read_table`; the error names the file."""
    try:
        return read_table(path, columns)
    except ParquetDamageError as error:
        raise ParquetDamageError(f"{path} is damaged: {error}.") from error


def _write_rows(source: Path, target: Path, stats: list[Stats]) -> None:
    rows = read_named_table(source)
    own = [stats[episode] for episode in rows.column("episode_index").to_pylist()]
    write_rows(with_sound_stats(rows, own).replace_schema_metadata(None), target)
