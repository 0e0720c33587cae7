"""The columns of a LeRobotDataset as arrays, and the files that hold them; without LeRobot, which takes seconds to import."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.confines import check_info
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH, list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked


def column_to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    """A column of numbers or of fixed-length lists of numbers, as an array (N,) or (N, values per row).

    Raises:
        ValueError: If rows are missing or of different lengths.
    """
    parts = [_flat(chunk) for chunk in column.chunks]
    flat = np.concatenate(parts) if parts else np.empty(0)
    if not _is_list(column.type):
        return flat
    if len(column) == 0 or len(flat) % len(column):
        raise ValueError(f"{len(flat)} values in {len(column)} rows: the rows differ in length, or some are missing")
    return flat.reshape(len(column), -1)


def numpy_to_column(values: np.ndarray, kind: pa.DataType) -> pa.Array:
    """Numbers (N,) or (N, values per row) as a column of some type, as a feature of this shape has it."""
    column = pa.array(np.ascontiguousarray(values).reshape(-1))
    if pa.types.is_fixed_size_list(kind):
        column = pa.FixedSizeListArray.from_arrays(column, kind.list_size)
    return column.cast(kind)


def with_values(table: pa.Table, name: str, values: Sequence | np.ndarray) -> pa.Table:
    """A table with other values in one of its columns, which keeps its place and its type."""
    field = table.schema.field(name)
    return table.set_column(table.column_names.index(name), field, pa.array(values, field.type))


def episode_bounds(episode_index: np.ndarray) -> tuple[list[int], list[int]]:
    """First row, and row after the last, of every episode, from the episode of each row (N,)."""
    changes = np.flatnonzero(np.diff(episode_index)) + 1
    starts = [0, *changes.tolist()]
    return starts, [*starts[1:], len(episode_index)]


def check_dataset_files(
    repo_id: str, root: str | Path | None = None, revision: str | None = None
) -> list[pq.FileMetaData]:
    """Refuse a local dataset that is empty or was cut off while it was written, or that no one should trust.

    Where no local dataset is, what the Hub's says about itself is fetched and checked; the rest LeRobot fetches later.

    Args:
        repo_id: The dataset's name.
        root: Its folder; None means LeRobot's own place for `repo_id`.
        revision: Of the dataset on the Hub, as LeRobot takes it.

    Returns:
        What its data files say of themselves; nothing where no local dataset is.

    Raises:
        ValueError: Naming the file that is damaged, the folder without data, or what leads out of the folder or claims
            more than is there.
        OSError: A file cannot be read now, which says nothing about what it holds.
    """
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if not (folder / INFO_PATH).is_file():
        from lerobot.datasets import LeRobotDatasetMetadata

        meta = LeRobotDatasetMetadata(repo_id, root=root, revision=revision)
        check_info(Path(meta.root), [], 0 if meta.episodes is None else len(meta.episodes))
        return []
    footers: dict[str, list[pq.FileMetaData]] = {"data": [], "meta": []}
    for path in [*list_files(folder, "data/*/*.parquet"), *list_files(folder, "meta/episodes/*/*.parquet")]:
        try:
            with open_checked(path) as file:
                footers[path.relative_to(folder).parts[0]].append(file.metadata)
        except ParquetDamageError as error:
            raise ValueError(
                f"'{path}' is truncated or not a parquet file ({error}). If the recording was "
                f"killed, its episodes can be saved: playbyear-repair --root={folder}"
            ) from error
    if not footers["data"]:
        raise ValueError(f"The dataset '{repo_id}' in '{folder}' is empty: no episode was saved. Record at least one.")
    check_info(folder, footers["data"], sum(footer.num_rows for footer in footers["meta"]))
    return footers["data"]


def _is_list(kind: pa.DataType) -> bool:
    return isinstance(kind, pa.BaseExtensionType) or pa.types.is_nested(kind)


def _flat(chunk: pa.Array) -> np.ndarray:
    while _is_list(chunk.type):
        chunk = chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk.flatten()
    if chunk.null_count:
        raise ValueError(f"{chunk.null_count} values are missing")
    return chunk.to_numpy(zero_copy_only=False)
