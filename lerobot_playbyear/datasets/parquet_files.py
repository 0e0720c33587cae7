"""How our parquet files are written: small sound, checked pages, and readers that know nothing of it.

LeRobot's own options (snappy, dictionaries, one row group per episode) with two differences that every reader of
parquet understands: PCM is stored as the differences of neighbouring samples, in as many bits as these need, and
every page carries a checksum, so that a flipped bit is found instead of heard.
"""

import contextlib
import errno
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq


class ParquetDamageError(ValueError):
    """A parquet file, or a part of it, does not hold what was written."""


PIECE_BYTES = 2**26
"""Of the rows that are in memory together, about: more is read and written in parts."""

_BUFFER_BYTES = 2**20
_VALUE_BYTES = {"BOOLEAN": 1, "INT32": 2, "INT64": 8, "FLOAT": 4, "DOUBLE": 8}  # at least; 16-bit sound is an INT32
_PARSE_ERRORS = (pa.ArrowException, OSError, ValueError, KeyError, IndexError, MemoryError, OverflowError)
_LARGEST_RATIO = 10_000  # of what a part of a file takes in memory to the file's own size


@contextlib.contextmanager
def parsing(path: Path | None = None) -> Iterator[None]:
    """Tells bytes that are wrong from bytes that cannot be read now, in whatever pyarrow does within.

    Args:
        path: The file that is read; None where it lies in memory.

    Raises:
        ParquetDamageError: The bytes were read, and are not what a parquet file holds.
        OSError: They could not be read, which says nothing about the file.
        MemoryError: There is no room for them.
    """
    try:
        yield
    except _PARSE_ERRORS as error:
        if isinstance(error, ParquetDamageError):
            raise
        if isinstance(error, OSError) and error.errno:  # pyarrow sets it where the system refused
            raise OSError(error.errno, os.strerror(error.errno), error.filename or (path and str(path))) from error
        if isinstance(error, MemoryError) and not _asks_for_the_impossible(error, path):
            raise
        raise ParquetDamageError(_first_line(error)) from error


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
            writer.write_table(table, row_group_size=_rows_within(PIECE_BYTES, table.nbytes, len(table)))


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


def open_checked(path: Path, footer: pq.FileMetaData | None = None) -> pq.ParquetFile:
    """Opens a file for reading with its pages' checksums verified, where it has them.

    Args:
        path: The file.
        footer: What is taken for its footer; None: its own.

    Raises:
        ParquetDamageError: It is not a complete parquet file.
        OSError: It cannot be read now; nor may later reads, see `parsing`.
    """
    with parsing(path):
        if footer is None:
            with path.open("rb") as file:
                if file.read(4) != b"PAR1":
                    raise ParquetDamageError("it does not begin as a parquet file does")
        return open_parquet(path, footer)


def open_parquet(path: Path, footer: pq.FileMetaData | None = None) -> pq.ParquetFile:
    """As `open_checked`, without a look at its beginning. Raises what pyarrow raises."""
    return pq.ParquetFile(
        path, metadata=footer, page_checksum_verification=True, pre_buffer=False, buffer_size=_BUFFER_BYTES
    )


def read_row_groups(
    file: pq.ParquetFile, columns: list[str] | None = None, path: Path | None = None
) -> Iterator[pa.Table | ParquetDamageError]:
    """Every row group of a file as a table, or as several where it is large; in place of a damaged one, what is wrong.

    Args:
        file: An opened file.
        columns: Which to read; None: all.
        path: Its name, for errors.

    Raises:
        OSError: The file cannot be read now.
        MemoryError: There is no room for a part of it.
    """
    for index in range(file.num_row_groups):
        try:
            with parsing(path):
                is_large = _row_group_bytes(file, index, columns) > 2 * PIECE_BYTES
                if is_large:  # it is read to its end first: of a damaged one nothing is given
                    for _ in row_group_parts(file, index, columns):
                        pass
                else:
                    table = file.read_row_group(index, columns=columns, use_threads=False)
                    table.validate(full=True)
        except ParquetDamageError as error:
            yield error
            continue
        if not is_large:
            yield table
            continue
        try:
            with parsing(path):
                yield from row_group_parts(file, index, columns)
        except ParquetDamageError as error:
            raise OSError(
                errno.EIO, f"what could be read before cannot be read now ({error})", path and str(path)
            ) from error


def row_group_parts(file: pq.ParquetFile, index: int, columns: list[str] | None = None) -> Iterator[pa.Table]:
    """A row group in parts of bounded size. Raises what pyarrow raises where it cannot be read."""
    group = file.metadata.row_group(index)
    rows = _rows_within(PIECE_BYTES, _row_group_bytes(file, index, columns), group.num_rows)
    for batch in file.iter_batches(rows, row_groups=[index], columns=columns, use_threads=False):
        table = pa.Table.from_batches([batch])
        table.validate(full=True)
        yield table


def _row_group_bytes(file: pq.ParquetFile, index: int, columns: list[str] | None) -> int:
    """About what a row group takes in memory."""
    group = file.metadata.row_group(index)
    chunks = (group.column(i) for i in range(group.num_columns))
    return sum(
        max(chunk.total_uncompressed_size, chunk.num_values * _VALUE_BYTES.get(chunk.physical_type, 1))
        for chunk in chunks
        if columns is None or chunk.path_in_schema.split(".")[0] in columns
    )


def _rows_within(limit: int, n_bytes: int, n_rows: int) -> int:
    """How many rows take so many bytes, where `n_rows` take `n_bytes`; at least one."""
    return max(min(n_rows, limit * n_rows // max(n_bytes, 1)), 1)


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Reads a whole file, with checksums.

    Raises:
        ParquetDamageError: A part of it is damaged.
        OSError: It cannot be read now.
    """
    with open_checked(path) as file, parsing(path):
        table = file.read(columns=columns, use_threads=False)
        table.validate(full=True)
    return table


def fit_to_schema(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """A table's columns in the order and types of a schema; what the table lacks is null, what it has more is left.

    Raises:
        pyarrow.ArrowInvalid: A column's type cannot become the schema's.
    """
    columns = [
        table.column(field.name).cast(field.type)
        if field.name in table.column_names
        else pa.nulls(len(table), field.type)
        for field in schema
    ]
    return pa.Table.from_arrays(columns, schema=schema)


def _asks_for_the_impossible(error: MemoryError, path: Path | None) -> bool:
    """Whether more memory was asked for than any part of the file can take: a size in it was misread."""
    asked = re.search(r"alloc of size (\d+) failed", str(error))
    limit = 2**40 if path is None else 2**30 + _LARGEST_RATIO * path.stat().st_size
    return asked is not None and int(asked[1]) > limit


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
