"""The files that a dataset has with one more episode, in LeRobot's layout, written beside the dataset.

LeRobot begins new files whenever a recording is continued. Here small files are continued instead: the new file takes
over what the last one of the dataset holds, and replaces it in one step. So a dataset of a thousand short episodes has
some files of several MB each, and one table of episodes.
"""

import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import RGBEncoderConfig, depth_encoder_defaults
from lerobot.datasets.compute_stats import sample_indices
from lerobot.datasets.io_utils import load_stats, load_tasks, write_info, write_tasks
from lerobot.datasets.utils import DEFAULT_EPISODES_PATH, DEFAULT_TASKS_PATH, DatasetInfo, update_chunk_file_indices
from lerobot.datasets.video_utils import encode_video_frames, get_video_duration_in_s, get_video_info
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.features import Features, arrow_schema, is_depth
from lerobot_playbyear.datasets.files import EPISODES_DIR, is_listed, list_files
from lerobot_playbyear.datasets.frame_rate import exact_rate
from lerobot_playbyear.datasets.journal import STAGING, remove_staged
from lerobot_playbyear.datasets.parquet import DataFile, ParquetDamageError, numpy_to_column, write_rows, write_tables
from lerobot_playbyear.datasets.pictures import decode_picture, open_film
from lerobot_playbyear.datasets.statistics import add_stats, numeric_stats, picture_stats, stats_columns, write_stats

logger = logging.getLogger(__name__)

SMALL_DATA_BYTES = 8 * 2**20
"""A data file below this is continued."""

SMALL_TABLE_BYTES = 2 * 2**20
"""A table of episodes below this is continued."""


def stage_episode(root: Path, info: DatasetInfo, frames: Sequence[Mapping[str, Any]], rgb: RGBEncoderConfig) -> None:
    """Writes all files of a dataset that change with one more episode, into its staging folder.

    Args:
        root: The dataset's folder.
        info: What its `meta/info.json` holds; it is changed to what that holds afterwards.
        frames: The episode, pictures compressed.
        rgb: How films are encoded, but those of distances.
    """
    remove_staged(root)
    staging = root / STAGING
    (staging / "meta").mkdir(parents=True)
    table, last = _last_row(root)
    index, n_frames, first = info.total_episodes, len(frames), info.total_frames
    texts = [frame["task"] for frame in frames]
    tasks = _tasks(root, texts)
    own = {key: feature for key, feature in info.features.items() if key not in DEFAULT_FEATURES}
    columns: dict[str, Any] = {key: _column([frame[key] for frame in frames], own[key]) for key in own}
    columns["timestamp"] = np.arange(n_frames) / info.fps  # float64 in statistics, as LeRobot has them
    columns["frame_index"] = np.arange(n_frames)
    columns["episode_index"] = np.full(n_frames, index)
    columns["index"] = np.arange(first, first + n_frames)
    columns["task_index"] = tasks.loc[texts].task_index.to_numpy()

    row: dict[str, Any] = {"episode_index": index, "tasks": list(dict.fromkeys(texts)), "length": n_frames}
    row |= _stage_data(root, info, columns, last)
    row |= {"dataset_from_index": first, "dataset_to_index": first + n_frames}
    for key, feature in info.features.items():
        if feature["dtype"] == "video":
            row |= _stage_film(root, info, key, columns[key], rgb, last)
    stats = _stats(columns, info.features)
    _stage_row(root, row | stats_columns(stats), table, last, info.chunks_size)

    write_tasks(tasks, staging)
    write_stats(add_stats(load_stats(root), [stats]), staging)
    info.total_episodes, info.total_frames, info.total_tasks = index + 1, first + n_frames, len(tasks)
    info.splits = {"train": f"0:{index + 1}"}
    write_info(info, staging)


def _column(values: list[Any], feature: Mapping[str, Any]) -> Any:
    """An episode's values of a feature: an array (N, ...), or a list of texts or of compressed pictures."""
    if feature["dtype"] in ("image", "video", "string", "language"):
        return values
    stacked = np.stack(values)
    return stacked.reshape(len(values)) if tuple(feature["shape"]) == (1,) else stacked


def _stats(columns: Mapping[str, Any], features: Features) -> dict[str, Any]:
    stats = numeric_stats({key: values for key, values in columns.items() if isinstance(values, np.ndarray)}, features)
    for key, feature in features.items():
        if feature["dtype"] in ("image", "video"):
            sampled = (decode_picture(columns[key][i]) for i in sample_indices(len(columns[key])))
            stats[key] = picture_stats(sampled, is_depth(feature))
    return {key: stats[key] for key in features if key in stats}  # in LeRobot's order


def _tasks(root: Path, texts: Sequence[str]) -> pd.DataFrame:
    """The dataset's tasks with those of an episode, by their texts."""
    known = load_tasks(root).task_index.to_dict() if is_listed(root, DEFAULT_TASKS_PATH) else {}
    for text in dict.fromkeys(texts):
        known.setdefault(text, len(known))
    return pd.DataFrame({"task_index": list(known.values())}, index=pd.Index(list(known), name="task"))


def _last_row(root: Path) -> tuple[Path | None, dict[str, Any]]:
    """The last table of episodes, and its last row without statistics; nothing in a new dataset."""
    tables = list_files(root, f"{EPISODES_DIR}/*/*.parquet")
    if not tables:
        return None, {}
    file = DataFile(tables[-1])
    names = [name for name in file.schema.names if not name.startswith("stats/")]
    return file.path, file.read(file.n_rows - 1, file.n_rows, names).to_pylist()[0]


def _place(root: Path, template: str, last: Mapping[str, Any], prefix: str, chunks_size: int) -> tuple[Path, dict]:
    """The first file after the last one that the dataset has not got, and the columns of an episode's row that name it."""
    chunk, file = last.get(f"{prefix}/chunk_index"), last.get(f"{prefix}/file_index")
    chunk, file = (0, 0) if chunk is None or file is None else update_chunk_file_indices(chunk, file, chunks_size)
    while is_listed(root, template.format(chunk_index=chunk, file_index=file)):
        chunk, file = update_chunk_file_indices(chunk, file, chunks_size)
    name = template.format(chunk_index=chunk, file_index=file)
    return Path(name), {f"{prefix}/chunk_index": chunk, f"{prefix}/file_index": file}


def _stage_data(root: Path, info: DatasetInfo, columns: Mapping[str, Any], last: Mapping[str, Any]) -> dict[str, int]:
    """Writes an episode's frames, behind those of the last small file. Returns where."""
    schema = arrow_schema(info.features)
    arrays = [_arrow_column(columns[name], schema.field(name).type, info.features[name]) for name in schema.names]
    name, place = _place(root, info.data_path, last, "data", info.chunks_size)
    before = []
    if last:
        own = info.data_path.format(chunk_index=last["data/chunk_index"], file_index=last["data/file_index"])
        if before := _continued(root / own, SMALL_DATA_BYTES, schema):
            name, place = Path(own), {key: last[key] for key in place}
    write_tables(root / STAGING / name, [*before, pa.Table.from_arrays(arrays, schema=schema)], schema)
    return place


def _arrow_column(values: Any, kind: pa.DataType, feature: Mapping[str, Any]) -> pa.Array:
    if feature["dtype"] == "image":
        suffix = "tiff" if is_depth(feature) else "png"
        named = [{"bytes": each, "path": f"frame-{i:06d}.{suffix}"} for i, each in enumerate(values)]
        return pa.array(named, kind)
    if isinstance(kind, pa.BaseExtensionType):  # of two dimensions and more
        return pa.ExtensionArray.from_storage(kind, pa.array(values.tolist(), kind.storage_type))
    return numpy_to_column(values, kind) if isinstance(values, np.ndarray) else pa.array(values, kind)


def _continued(path: Path, limit: int, schema: pa.Schema) -> list[pa.Table]:
    """The row groups of a small file, which is continued; none of one that is large, damaged or of other columns."""
    if not path.is_file() or path.stat().st_size >= limit:
        return []
    tables = []
    try:
        file = DataFile(path)
        if not file.schema.remove_metadata().equals(schema.remove_metadata()):
            raise ParquetDamageError("its columns are of other types")
        for _, table in file.row_groups():
            if isinstance(table, ParquetDamageError):
                raise table
            tables.append(table.replace_schema_metadata(schema.metadata))
    except (ParquetDamageError, pa.ArrowException) as error:
        logger.warning("%s is not continued: %s.", path, error)
        return []
    return tables


def _stage_film(
    root: Path, info: DatasetInfo, key: str, pictures: Sequence[bytes], rgb: RGBEncoderConfig, last: Mapping[str, Any]
) -> dict[str, Any]:
    """Encodes an episode's film of one camera, a file of its own. Returns what its row says of it."""
    feature = info.features[key]
    encoder = depth_encoder_defaults() if is_depth(feature) else rgb
    template = str(info.video_path).replace("{video_key}", key)
    name, place = _place(root, template, last, f"videos/{key}", info.chunks_size)
    path, folder = root / STAGING / name, root / STAGING / "pictures"
    folder.mkdir()
    for number, picture in enumerate(pictures):
        (folder / f"frame-{number:06d}.{'tiff' if is_depth(feature) else 'png'}").write_bytes(picture)
    encode_video_frames(folder, path, exact_rate(info.fps), video_encoder=encoder)  # type: ignore[arg-type]
    shutil.rmtree(folder)
    with open_film(str(path)) as container:
        n_frames = sum(1 for packet in container.demux(video=0) if packet.size)
    if n_frames != len(pictures):
        raise OSError(
            f"the video of '{key}' has {n_frames} frames where {len(pictures)} were recorded: the encoder lost some, or the "
            "disk is full"
        )
    if info.total_episodes == 0:
        feature["info"] = {**(feature.get("info") or {}), **get_video_info(path, video_encoder=encoder)}
    times = {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": get_video_duration_in_s(path)}
    return {**place, **times}


def _stage_row(root: Path, row: dict[str, Any], table: Path | None, last: Mapping[str, Any], chunks_size: int) -> None:
    """Puts the episode's row behind those of the last small table of episodes."""
    name, place = _place(root, DEFAULT_EPISODES_PATH, last, "meta/episodes", chunks_size)
    schema = None if table is None else pq.read_schema(table).remove_metadata()
    before = [] if table is None else _continued(table, SMALL_TABLE_BYTES, schema)
    if table is not None and before:
        name, place = table.relative_to(root), {key: last[key] for key in place}
    rows = pa.Table.from_pylist([row | place], schema)  # what the schema lacks is left out
    write_rows(pa.concat_tables([*before, rows]).combine_chunks(), root / STAGING / name)
