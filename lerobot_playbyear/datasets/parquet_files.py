"""How our parquet files are written: small sound, checked pages, and readers that know nothing of it.

LeRobot's own options (snappy, dictionaries, one row group per episode) with two differences that every reader of
parquet understands: PCM is stored as the differences of neighbouring samples, in as many bits as these need, and
every page carries a checksum, so that a flipped bit is found instead of heard.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq


class ParquetDamageError(ValueError):
    """A parquet file, or a part of it, does not hold what was written."""


READ_ERRORS = (pa.ArrowException, OSError, ValueError, KeyError, IndexError, MemoryError, OverflowError)
"""What pyarrow raises for damaged files."""


def write_tables(path: Path, tables: Iterable[pa.Table], schema: pa.Schema) -> None:
    """Writes a file with one row group per table.

    Args:
        path: The file; its folder is made.
        tables: All of one schema.
        schema: Theirs.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, schema, **writer_options(schema)) as writer:
        for table in tables:
            writer.write_table(table, row_group_size=max(len(table), 1))


def writer_options(schema: pa.Schema) -> dict:
    """Options of `pyarrow.parquet.ParquetWriter` for a data file."""
    leaves = [leaf for field in schema for leaf in leaf_columns(field.name, field.type)]
    pcm = {path for path, kind, nested in leaves if nested and kind == pa.int16()}
    counters = {path for path, kind, nested in leaves if not nested and kind == pa.int64()}  # most go up by one
    pictures = {path for path, kind, _ in leaves if pa.types.is_binary(kind)}
    deltas = pcm | counters
    return {
        "compression": "snappy",
        "use_dictionary": [path for path, _, _ in leaves if path not in deltas | {"timestamp"}],
        "column_encoding": dict.fromkeys(deltas, "DELTA_BINARY_PACKED") or None,
        "write_page_checksum": True,
        # Readers skip row groups by these; for sound and pictures they would only take room.
        "write_statistics": [path for path, _, nested in leaves if not nested and path not in pictures] or False,
    }


def leaf_columns(path: str, kind: pa.DataType) -> list[tuple[str, pa.DataType, bool]]:
    """Parquet's columns below an Arrow column: path, type, and whether it lies in a list, in the file's order."""
    if isinstance(kind, pa.BaseExtensionType):
        return leaf_columns(path, kind.storage_type)
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return [(name, leaf, True) for name, leaf, _ in leaf_columns(f"{path}.list.element", kind.value_type)]
    if pa.types.is_struct(kind):
        return [column for field in kind for column in leaf_columns(f"{path}.{field.name}", field.type)]
    return [(path, kind, False)]


def open_checked(path: Path) -> pq.ParquetFile:
    """Opens a file for reading with its pages' checksums verified, where it has them.

    Raises:
        ParquetDamageError: It is not a complete parquet file.
    """
    try:
        with path.open("rb") as file:
            if file.read(4) != b"PAR1":
                raise ParquetDamageError("it does not begin as a parquet file does")
        return pq.ParquetFile(path, page_checksum_verification=True)
    except READ_ERRORS as error:
        raise ParquetDamageError(_first_line(error)) from error


def read_row_groups(file: pq.ParquetFile, columns: list[str] | None = None) -> Iterator[pa.Table | ParquetDamageError]:
    """Every row group of a file as a table; in place of one that cannot be read, what is wrong with it."""
    for index in range(file.num_row_groups):
        try:
            table = file.read_row_group(index, columns=columns, use_threads=False)
            table.validate(full=True)
            yield table
        except READ_ERRORS as error:
            yield ParquetDamageError(_first_line(error))


def read_table(path: Path, columns: list[str] | None = None) -> pa.Table:
    """Reads a whole file, with checksums.

    Raises:
        ParquetDamageError: A part of it cannot be read.
    """
    file = open_checked(path)
    try:
        table = file.read(columns=columns, use_threads=False)
        table.validate(full=True)
    except READ_ERRORS as error:
        raise ParquetDamageError(_first_line(error)) from error
    finally:
        file.close()
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


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
