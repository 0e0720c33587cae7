"""Turns the episode that LeRobot wrote into the files that the dataset shall hold with it.

LeRobot begins new files whenever a recording is continued. Here small files are continued instead: the staged file
takes over what the last one of the dataset holds, and replaces it in one step. So a dataset of a thousand short
episodes has some files of several MB each, and one table of episodes.
"""

import dataclasses
import logging
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_stats, write_info
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, DatasetInfo

from lerobot_playbyear.datasets.journal import STAGING
from lerobot_playbyear.datasets.parquet import (
    ParquetDamageError,
    fit_to_schema,
    numpy_to_column,
    open_checked,
    read_row_groups,
    read_table,
    with_values,
    write_tables,
)
from lerobot_playbyear.datasets.staging import Staging, last_episode
from lerobot_playbyear.datasets.statistics import add_stats, sound_stats, with_sound_stats
from lerobot_playbyear.datasets.statistics import write_stats as write_dataset_stats
from lerobot_playbyear.datasets.video_seal import is_intact, seal

logger = logging.getLogger(__name__)

INFO = Path("meta/info.json")
_SMALL_DATA_BYTES = 8 * 2**20  # a data file below this is continued
_SMALL_TABLE_BYTES = 2 * 2**20  # a table of episodes below this is continued


def settle_episode(root: Path, episode: Staging, waveforms: Mapping[str, np.ndarray]) -> None:
    """Makes of one episode's files what the dataset in `root` shall hold, in its staging folder.

    LeRobot's files are left as they are, but for films, which are moved: after a failure this can be called again.

    Args:
        root: The dataset's folder.
        episode: The episode, written and closed by LeRobot.
        waveforms: Its sound, (n_frames, S) per microphone.
    """
    source, folder, meta = episode.folder, root / STAGING, episode.dataset.meta
    for part in ("data", "meta"):
        shutil.rmtree(folder / part, ignore_errors=True)  # of a try that failed
    (folder / "meta").mkdir(parents=True)
    (row_file,) = _new_files(episode, "meta/episodes")
    info = dataclasses.replace(
        meta.info, features={key: meta.features.get(key, feature) for key, feature in episode.features.items()}
    )
    write_info(info, folder)
    tables = sorted(root.glob("meta/episodes/*/*.parquet"))
    last = last_episode(tables[-1]).to_pylist()[0] if tables else None
    sound = {key: sound_stats(waveform) for key, waveform in waveforms.items()}
    row = with_sound_stats(pq.read_table(source / row_file), [sound])
    row = _settle_data(root, episode, info, row, last, waveforms)
    _settle_row(root, folder, row, row_file, last)
    for name in _new_files(episode, "meta"):
        if len(name.parts) == 2 and name != INFO:
            shutil.copyfile(source / name, folder / name)
    if meta.stats is not None and sound:
        known = {key: stats for key, stats in (load_stats(root) or {}).items() if key in sound}
        write_dataset_stats({**meta.stats, **add_stats(known, [sound], sound)}, folder)
    for name in _new_files(episode, "videos"):  # those that an earlier try moved are there already
        if not is_intact(source / name):
            seal(source / name)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(source / name, folder / name)


def _new_files(episode: Staging, part: str) -> list[Path]:
    paths = (path for path in sorted((episode.folder / part).rglob("*")) if path.is_file())
    return [name for path in paths if (name := path.relative_to(episode.folder)) not in episode.before]


def _settle_data(
    root: Path,
    episode: Staging,
    info: DatasetInfo,
    row: pa.Table,
    last: dict | None,
    waveforms: Mapping[str, np.ndarray],
) -> pa.Table:
    """Writes the episode's frames as our files are written, behind those of the last small file. Returns its row."""
    name = _data_file(info, row.to_pylist()[0])
    frames = _with_sound(pq.read_table(episode.folder / name), info, waveforms)
    target, tables = name, [frames]
    if last is not None and _is_small(root / _data_file(info, last), _SMALL_DATA_BYTES):
        try:
            tables = [*_tables_of(root / _data_file(info, last), frames.schema), frames]
            target = _data_file(info, last)
        except (ParquetDamageError, pa.ArrowException) as error:
            logger.warning("%s is not continued: %s.", root / _data_file(info, last), error)
    write_tables(root / STAGING / target, tables, frames.schema)
    if target != name:
        assert last is not None
        for key in ("data/chunk_index", "data/file_index"):
            row = with_values(row, key, [last[key]])
    return row


def _with_sound(frames: pa.Table, info: DatasetInfo, waveforms: Mapping[str, np.ndarray]) -> pa.Table:
    """An episode's frames with its microphones' columns, all in the order of the features."""
    schema = get_hf_features_from_features(info.features).arrow_schema
    for key, waveform in waveforms.items():
        frames = frames.append_column(key, numpy_to_column(waveform, schema.field(key).type))
    return frames.select(schema.names).cast(schema)


def _settle_row(root: Path, staging: Path, row: pa.Table, name: Path, last: dict | None) -> None:
    """Puts the episode's row behind those of the last small table of episodes."""
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
                    row = with_values(row, key, [last[key]])
                table, name = pa.concat_tables([rows, row]).combine_chunks(), last_name
            except ParquetDamageError as error:
                logger.warning("%s is not continued: %s.", root / last_name, error)
    write_rows(table, staging / name)


def write_rows(rows: pa.Table, path: Path) -> None:
    """Writes a table of episodes. Its footer carries nothing that a reader could do without: it is most of the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(
        rows, path, compression="snappy", write_page_checksum=True, write_statistics=False, store_schema=False
    )


def _data_file(info: DatasetInfo, row: dict) -> Path:
    return Path(info.data_path.format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]))


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
