"""Parquet files of frames: columns as arrays, files that lost their end, and how ours are written.

Written with LeRobot's own options (snappy, dictionaries, one row group per episode) and two differences that every
reader of parquet understands: PCM is stored as the differences of neighbouring samples, in as many bits as these need,
and every page carries a checksum, so that a flipped bit is found instead of heard.
"""

import contextlib
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.errors import first_line
from lerobot_playbyear.datasets.free_memory import available_memory


class ParquetDamageError(ValueError):
    """A parquet file, or a part of it, does not hold what was written."""


PIECE_BYTES = 2**26
"""Of the rows that are in memory together, about: more is read and written in parts."""

_READING = {"page_checksum_verification": True, "pre_buffer": False, "buffer_size": 2**20}
_COLUMN_BYTES, _OBJECT_BYTES = 4, 20  # of a number, in a column and as Python has it, about
_IMPOSSIBLE_BYTES = 2**40  # more memory than any part of a file takes
_PARSE_ERRORS = (pa.ArrowException, OSError, ValueError, KeyError, IndexError, MemoryError, OverflowError)


@contextlib.contextmanager
def parsing(path: Path) -> Iterator[None]:
    """Tells bytes that are wrong from bytes that cannot be read now, in whatever pyarrow does within.

    Args:
        path: The file that is read.

    Raises:
        ParquetDamageError: The bytes were read, and are not what a parquet file holds.
        OSError: They could not be read, which says nothing about the file.
        MemoryError: There is no room for them.
    """
    try:
        yield
    except ParquetDamageError:
        raise
    except _PARSE_ERRORS as error:
        if isinstance(error, OSError) and error.errno:  # pyarrow sets it where the system refused
            raise OSError(error.errno, os.strerror(error.errno), error.filename or str(path)) from error
        if isinstance(error, MemoryError) and not _asks_for_the_impossible(error):
            raise
        raise ParquetDamageError(first_line(error)) from error


def open_checked(path: Path, footer: pq.FileMetaData | None = None, coded: Sequence[str] = ()) -> pq.ParquetFile:
    """Opens a file for reading with its pages' checksums verified, where it has them.

    Args:
        path: The file.
        footer: What is taken for its footer; None: its own.
        coded: The columns of texts that stay dictionaries.

    Raises:
        ParquetDamageError: It is not a complete parquet file.
        OSError: It cannot be read now; nor may later reads, see `parsing`.
    """
    with parsing(path):
        if footer is None:
            with path.open("rb") as file:
                if file.read(4) != b"PAR1":
                    raise ParquetDamageError("it does not begin as a parquet file does")
        return pq.ParquetFile(path, metadata=footer, read_dictionary=list(coded), **_READING)


def check_room(path: Path, footer: pq.FileMetaData, group: int | None = None) -> None:
    """Whether the values of a file fit into memory: equal ones take next to no room in it.

    Args:
        path: The file, for the message.
        footer: Its footer.
        group: Only this row group, as columns; None: all, as objects of Python.

    Raises:
        MemoryError: They do not.
    """
    groups = map(footer.row_group, range(footer.num_row_groups) if group is None else [group])
    n_values = sum(own.column(i).num_values for own in groups for i in range(own.num_columns))
    _check_free(path, f"{n_values:,} values", n_values * (_OBJECT_BYTES if group is None else _COLUMN_BYTES))


def _check_free(path: Path, what: str, wanted: int) -> None:
    if wanted > PIECE_BYTES and 2 * wanted > (free := available_memory()):
        raise MemoryError(
            f"'{path}' holds {what} in one piece, which take {wanted / 2**30:.1f} GiB of memory, and "
            f"{free / 2**30:.1f} GiB are free. Use a machine with more, or ask who made the dataset."
        )


def _n_bytes(texts: pa.Array) -> int:
    """What texts take that are coded as dictionaries, or lists and structures of them."""
    if pa.types.is_dictionary(texts.type):
        return pc.sum(pc.binary_length(texts.dictionary).take(texts.indices)).as_py() or 0
    parts = texts.flatten() if pa.types.is_nested(texts.type) else []
    return sum(map(_n_bytes, parts if isinstance(parts, list) else [parts]))


class DataFile:
    """A parquet file that is read row group by row group; where one is damaged, the others can still be read.

    Args:
        path: The file.
        footer: What is taken for its footer where it has lost its own.

    Attributes:
        path: The file.
        footer: Its footer, or what is taken for it.
        schema: Of its columns.
        n_rows: All its rows.

    Raises:
        ParquetDamageError: It is not a complete parquet file.
        OSError: It cannot be read now.
    """

    def __init__(self, path: Path, footer: pq.FileMetaData | None = None) -> None:
        with open_checked(path, footer) as file:
            self.path, self.footer, self.schema = path, file.metadata, file.schema_arrow
        sizes = [self.footer.row_group(group).num_rows for group in range(self.footer.num_row_groups)]
        self._edges = [0, *np.cumsum(sizes, dtype=int).tolist()]
        self.n_rows = self._edges[-1]
        self._last: tuple[int, list[str] | None, pa.Table | ParquetDamageError] | None = None  # what was read last

    def row_groups(self, columns: list[str] | None = None) -> Iterator[tuple[int, pa.Table | ParquetDamageError]]:
        """The first row of every row group, and its rows, or what is wrong with them.

        Args:
            columns: Which to read; None: all.

        Raises:
            OSError: They cannot be read now.
            MemoryError: There is no room for them.
        """
        with open_checked(self.path, self.footer) as file:
            for group, first in enumerate(self._edges[:-1]):
                yield first, self._read_group(file, group, columns)

    def read(self, start: int, stop: int, columns: list[str] | None = None) -> pa.Table:
        """Some of the rows. Whoever reads on reads no row group twice.

        Args:
            start: The first.
            stop: The one after the last.
            columns: Which to read; None: all.

        Raises:
            ParquetDamageError: Some of them are damaged.
            OSError: They cannot be read now.
            MemoryError: There is no room for them.
        """
        tables = [
            self._group(group, columns).slice(max(start - first, 0), min(stop, end) - max(start, first))
            for group, (first, end) in enumerate(zip(self._edges, self._edges[1:], strict=False))
            if first < stop and end > start
        ]
        return pa.concat_tables(tables) if tables else self.schema.empty_table().select(columns or self.schema.names)

    def _group(self, group: int, columns: list[str] | None) -> pa.Table:
        last = self._last  # another thread may read something else meanwhile
        if last is None or last[:2] != (group, columns):
            with open_checked(self.path, self.footer) as file:
                last = self._last = (group, columns, self._read_group(file, group, columns))
        table = last[2]
        if isinstance(table, ParquetDamageError):
            raise ParquetDamageError(f"{self.path} is damaged: {table}.")
        return table

    def _read_group(self, file: pq.ParquetFile, group: int, columns: list[str] | None) -> pa.Table | ParquetDamageError:
        """A row group of the opened file, or what is wrong with it. Raises as `row_groups`."""
        check_room(self.path, self.footer, group)
        try:
            with parsing(self.path):
                table = file.read_row_group(group, columns=columns, use_threads=False)
                table.validate(full=True)
                return table
        except ParquetDamageError as error:
            return error


def read_table(path: Path) -> pa.Table:
    """Reads a whole file, with checksums.

    Raises:
        ParquetDamageError: A part of it is damaged.
        OSError: It cannot be read now.
        MemoryError: There is no room for it.
    """
    with open_checked(path) as file, parsing(path):
        check_room(path, file.metadata)
        leaves = map(file.schema.column, range(len(file.schema)))
        texts = [leaf.path for leaf in leaves if leaf.physical_type == "BYTE_ARRAY"]
        with open_checked(path, file.metadata, texts) as coded:
            chunks = [chunk for column in coded.read(texts, use_threads=False).columns for chunk in column.chunks]
        _check_free(path, "texts", sum(map(_n_bytes, chunks)))
        table = file.read(use_threads=False)
        table.validate(full=True)
    return table


def column_to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    """A column of numbers or of fixed-length lists of numbers, as an array (N,) or (N, values per row).

    Raises:
        ValueError: If rows are missing or of different lengths.
    """
    if column.null_count:
        raise ValueError(f"{column.null_count} of {len(column)} rows are missing")
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


def episode_bounds(episode_index: np.ndarray) -> tuple[list[int], list[int]]:
    """First row, and row after the last, of every episode, from the episode of each row (N,)."""
    changes = np.flatnonzero(np.diff(episode_index)) + 1
    starts = [0, *changes.tolist()]
    return starts, [*starts[1:], len(episode_index)]


def stretches(flags: np.ndarray) -> np.ndarray:
    """Where flags (T,) are true without a gap, (n, 2): the first row of each stretch, and the one after its last."""
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def write_tables(path: Path, tables: Iterable[pa.Table], schema: pa.Schema) -> None:
    """Writes a file with one row group per table, or several where a table is large: readers hold a whole one.

    Args:
        path: The file; its folder is made.
        tables: All of one schema.
        schema: Theirs.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, schema, **writer_options(schema)) as writer:
        for table in tables:
            writer.write_table(table, row_group_size=max(PIECE_BYTES * len(table) // max(table.nbytes, 1), 1))


def write_rows(rows: pa.Table, path: Path) -> None:
    """Writes a table of episodes. Its footer carries nothing that a reader could do without: it is most of the file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(rows, path, write_page_checksum=True, write_statistics=False, store_schema=False)


def writer_options(schema: pa.Schema) -> dict:
    """Options of `pyarrow.parquet.ParquetWriter` for a data file."""
    leaves = [leaf for field in schema for leaf in leaf_columns(field.name, field.type)]
    pcm = {leaf.path for leaf in leaves if leaf.nested and leaf.kind == pa.int16()}
    counters = {leaf.path for leaf in leaves if not leaf.nested and leaf.kind == pa.int64()}  # most go up by one
    pictures = {leaf.path for leaf in leaves if pa.types.is_binary(leaf.kind)}
    deltas = pcm | counters
    return {
        "compression": "snappy",
        "use_dictionary": [leaf.path for leaf in leaves if leaf.path not in deltas | {"timestamp"}],
        "column_encoding": dict.fromkeys(deltas, "DELTA_BINARY_PACKED") or None,
        "write_page_checksum": True,
        # Readers skip row groups by these; for sound and pictures they would only take room.
        "write_statistics": [leaf.path for leaf in leaves if not leaf.nested and leaf.path not in pictures] or False,
    }


class Leaf(NamedTuple):
    """A column of parquet: its path and type, whether it lies in a list, and its values in a row; 0 where that varies."""

    path: str
    kind: pa.DataType
    nested: bool
    values_per_row: int


def leaf_columns(path: str, kind: pa.DataType) -> list[Leaf]:
    """Parquet's columns below an Arrow column, in the file's order."""
    if isinstance(kind, pa.BaseExtensionType):
        return leaf_columns(path, kind.storage_type)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        size = kind.list_size if pa.types.is_fixed_size_list(kind) else 0
        leaves = leaf_columns(f"{path}.list.element", kind.value_type)
        return [Leaf(leaf.path, leaf.kind, True, size * leaf.values_per_row) for leaf in leaves]
    if pa.types.is_struct(kind):
        return [column for field in kind for column in leaf_columns(f"{path}.{field.name}", field.type)]
    return [Leaf(path, kind, False, 1)]


def holds_numbers(kind: pa.DataType) -> bool:
    """Whether a column holds numbers or truth values, or lists of them."""
    kinds = [leaf.kind for leaf in leaf_columns("", kind)]
    return all(pa.types.is_integer(each) or pa.types.is_floating(each) or pa.types.is_boolean(each) for each in kinds)


def are_alike(one: pa.DataType, other: pa.DataType) -> bool:
    """Whether two columns hold the same kind of values; other tools write lists without their length."""
    kinds = [each.storage_type if isinstance(each, pa.BaseExtensionType) else each for each in (one, other)]
    sizes = {each.list_size for each in kinds if pa.types.is_fixed_size_list(each)}
    return len(sizes) < 2 and len(set(map(pa.types.is_nested, kinds))) == len(set(map(holds_numbers, kinds))) == 1


def _is_list(kind: pa.DataType) -> bool:
    return isinstance(kind, pa.BaseExtensionType) or pa.types.is_nested(kind)


def _flat(chunk: pa.Array) -> np.ndarray:
    while _is_list(chunk.type):
        chunk = chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk.flatten()
    if chunk.null_count:
        raise ValueError(f"{chunk.null_count} values are missing")
    return chunk.to_numpy(zero_copy_only=False)


def _asks_for_the_impossible(error: MemoryError) -> bool:
    """Whether more memory was asked for than there can be: a size in the file was misread."""
    asked = re.search(r"alloc of size (\d+) failed", str(error))
    return asked is not None and int(asked[1]) > _IMPOSSIBLE_BYTES
