"""Turns the episode that LeRobot wrote into the staging folder into its place in the dataset.

LeRobot begins new files whenever a recording is continued. Here small files are continued instead: the staged file
takes over what the last one of the dataset holds, and replaces it in one step. So a dataset of a thousand short
episodes has some files of several MB each, and one table of episodes.
"""

import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.parquet_files import (
    ParquetDamageError,
    fit_to_schema,
    open_checked,
    read_row_groups,
    read_table,
    write_tables,
)
from lerobot_playbyear.datasets.statistics import add_stats, read_stats, row_stats, sound_stats, with_sound_stats
from lerobot_playbyear.datasets.statistics import write_stats as write_dataset_stats
from lerobot_playbyear.datasets.video_seal import seal

logger = logging.getLogger(__name__)

INFO = Path("meta/info.json")
_SMALL_DATA_BYTES = 8 * 2**20  # a data file below this is continued
_SMALL_TABLE_BYTES = 2 * 2**20  # a table of episodes below this is continued


def settle_episode(root: Path, staging: Path, meta: LeRobotDatasetMetadata, before: set[Path]) -> list[Path]:
    """Makes the staged files of one episode what the dataset in `root` shall hold.

    Args:
        root: The dataset's folder; only read.
        staging: The staging dataset's folder, closed by LeRobot.
        meta: The staging dataset's metadata.
        before: Files, relative to `staging`, that were put there for LeRobot to continue from.

    Returns:
        The files to publish, relative to `staging`, in the order in which they may be moved one by one.
    """
    (row_file,) = _new_files(staging, "meta/episodes", before)
    row = pq.read_table(staging / row_file)
    last = _last_row(root)
    row, waveforms = _settle_data(root, staging, meta, row, last)
    sound = {key: sound_stats(waveform) for key, waveform in waveforms.items()}
    row = with_sound_stats(row, sound)
    row_file = _settle_row(root, staging, row, row_file, last)
    _settle_stats(root, staging, meta, row, list(sound))
    names = [path for folder in ("data", "videos") for path in _new_files(staging, folder, before)]
    for name in names:
        if name.suffix == ".mp4":
            seal(staging / name)
    tables = [path for path in _new_files(staging, "meta", before) if path not in (row_file, INFO)]
    return [*names, *tables, row_file, INFO]


def _new_files(staging: Path, folder: str, before: set[Path]) -> list[Path]:
    paths = (path for path in sorted((staging / folder).rglob("*")) if path.is_file())
    return [name for path in paths if (name := path.relative_to(staging)) not in before]


def _last_row(root: Path) -> dict | None:
    """The last episode of a dataset, without its statistics."""
    paths = sorted(root.glob("meta/episodes/*/*.parquet"))
    if not paths:
        return None
    columns = [name for name in pq.read_schema(paths[-1]).names if not name.startswith("stats/")]
    return pq.read_table(paths[-1], columns=columns).slice(pq.read_metadata(paths[-1]).num_rows - 1).to_pylist()[0]


def _settle_data(
    root: Path, staging: Path, meta: LeRobotDatasetMetadata, row: pa.Table, last: dict | None
) -> tuple[pa.Table, dict[str, np.ndarray]]:
    """Writes the episode's frames as our files are written, behind those of the last small file."""
    name = _data_file(meta, row.to_pylist()[0])
    frames = pq.read_table(staging / name)
    waveforms = {
        key: column_to_numpy(frames.column(key)).reshape(len(frames), -1)
        for key in audio_keys(frames.column_names)
        if meta.features[key]["dtype"] != "string"
    }
    target, tables = name, [frames]
    if last is not None and _is_small(root / _data_file(meta, last), _SMALL_DATA_BYTES):
        try:
            tables = [*_tables_of(root / _data_file(meta, last), frames.schema), frames]
            target = _data_file(meta, last)
        except (ParquetDamageError, pa.ArrowException) as error:
            logger.warning("%s is not continued: %s.", root / _data_file(meta, last), error)
    (staging / name).unlink()
    write_tables(staging / target, tables, frames.schema)
    if target != name:
        assert last is not None
        for key in ("data/chunk_index", "data/file_index"):
            row = row.set_column(row.column_names.index(key), key, pa.array([last[key]], row.schema.field(key).type))
    return row, waveforms


def _settle_row(root: Path, staging: Path, row: pa.Table, name: Path, last: dict | None) -> Path:
    """Puts the episode's row behind those of the last small table of episodes."""
    (staging / name).unlink()
    table = row
    if last is not None:
        keys = ("meta/episodes/chunk_index", "meta/episodes/file_index")
        last_name = Path(DEFAULT_EPISODES_PATH.format(chunk_index=last[keys[0]], file_index=last[keys[1]]))
        if not (root / last_name).is_file():  # copied by a tool that did not renumber
            last_name = sorted(root.glob("meta/episodes/*/*.parquet"))[-1].relative_to(root)
        row = fit_to_schema(row, pq.read_schema(root / last_name).remove_metadata())
        table = row
        if _is_small(root / last_name, _SMALL_TABLE_BYTES):
            try:
                rows = read_table(root / last_name).replace_schema_metadata(None)
                for key in keys:
                    value = pa.array([last[key]], row.schema.field(key).type)
                    row = row.set_column(row.column_names.index(key), key, value)
                table, name = pa.concat_tables([rows, row]).combine_chunks(), last_name
            except ParquetDamageError as error:
                logger.warning("%s is not continued: %s.", root / last_name, error)
    write_rows(table, staging / name)
    return name


def write_rows(rows: pa.Table, path: Path) -> None:
    """Writes a table of episodes. Its footer carries nothing that a reader could do without: it is most of the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        rows, path, compression="snappy", write_page_checksum=True, write_statistics=False, store_schema=False
    )


def _settle_stats(
    root: Path, staging: Path, meta: LeRobotDatasetMetadata, row: pa.Table, microphones: list[str]
) -> None:
    """Corrects the sound's entries in the dataset's statistics, which LeRobot made from those it knew."""
    if not microphones or meta.stats is None:
        return
    own = {key: stats for key, stats in row_stats(row.to_pylist()[0]).items() if key in microphones}
    known = read_stats(root) or {}
    known = {key: known[key] for key in microphones if key in known}
    write_dataset_stats({**meta.stats, **add_stats(known, [own], microphones)}, staging)


def _data_file(meta: LeRobotDatasetMetadata, row: dict) -> Path:
    return Path(meta.data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]))


def _is_small(path: Path, limit: int) -> bool:
    return path.is_file() and path.stat().st_size < limit


def _tables_of(path: Path, schema: pa.Schema) -> list[pa.Table]:
    """The row groups of a data file.

    Raises:
        ParquetDamageError: One of them is damaged, or the file has other columns.
    """
    with open_checked(path) as file:
        if not file.schema_arrow.remove_metadata().equals(schema.remove_metadata()):
            raise ParquetDamageError("its columns are of other types")
        tables = []
        for table in read_row_groups(file):
            if isinstance(table, ParquetDamageError):
                raise table
            tables.append(table.replace_schema_metadata(schema.metadata))
    return tables
