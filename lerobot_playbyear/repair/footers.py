"""Footers of parquet files, made again: of a recording that was killed, or cut off by a full disk.

A parquet file's footer says where everything is, and is written last. LeRobot writes it when the recording ends,
but it writes every episode's pages, with a header each, when the episode is saved. From these headers, and the
columns that the dataset's features demand, the footer is written again; pyarrow then reads the file as usual.

Headers and footers are structures of Thrift's compact protocol, of which the second half of this module is as much as
parquet uses.
"""

import io
import logging
import os
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.files import naming
from lerobot_playbyear.datasets.parquet import ParquetDamageError, leaf_columns, open_checked, parsing

logger = logging.getLogger(__name__)

BOOL_TRUE, BOOL_FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)

_MAGIC = b"PAR1"
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3
_MAX_HEADER_BYTES = 2**16
_MOST_PAGES = 1000  # of an episode's first column: a stranger's may be of one byte


class ThriftError(ValueError):
    """The bytes are no Thrift structure."""


class Elements(NamedTuple):
    """A list of values of one type."""

    type: int
    values: list[Any]


class Struct(dict[int, tuple[int, Any]]):
    """Fields by their number: type and value."""

    def value(self, field: int) -> Any:
        """The value of a field; None where it is absent."""
        return self[field][1] if field in self else None


class _Page(NamedTuple):
    """One page: where it begins, its bytes with and without its header, and how many values it holds."""

    start: int
    stored: int
    inflated: int
    is_dictionary: bool
    n_values: int


def rescue(path: Path, schema: pa.Schema) -> pq.FileMetaData | None:
    """What a parquet file without a valid footer would say in one.

    Args:
        path: The damaged file.
        schema: The columns that it should have, in any order that LeRobot or we write: the schema's.

    Returns:
        A footer that names every complete row group; None where there is none.

    Raises:
        OSError: The file cannot be read now.
    """
    values_per_row = [leaf.values_per_row for field in schema for leaf in leaf_columns(field.name, field.type)]
    if 0 in values_per_row:
        return None  # lists of no fixed length: where a row ends does not follow from the pages' headers
    with naming(path), path.open("rb") as file:
        pages = _pages(file)
    groups = _row_groups(pages, values_per_row)
    if not groups:
        return None
    footer = _empty_footer(schema)
    columns = [chunk.value(3) for chunk in footer.value(4).values[0].value(1).values]
    footer[3] = (I64, sum(n_rows for n_rows, _ in groups))
    footer[4] = (LIST, Elements(STRUCT, [_row_group(columns, *group) for group in groups]))
    encoded = write_struct(footer)
    try:
        with parsing(path):
            metadata = pq.read_metadata(io.BytesIO(_MAGIC + encoded + len(encoded).to_bytes(4, "little") + _MAGIC))
            open_checked(path, metadata).close()
    except ParquetDamageError as error:
        logger.debug("%s: the footer that was made for it is not accepted: %s", path, error)
        return None
    return metadata


def _empty_footer(schema: pa.Schema) -> Struct:
    """The footer of a file with one row group, in which no row is: LeRobot's and our own describe the columns alike."""
    buffer = io.BytesIO()
    pq.write_table(schema.empty_table(), buffer, compression="snappy")
    data = buffer.getvalue()
    return read_struct(data[-8 - int.from_bytes(data[-8:-4], "little") :])[0]


def _pages(file: BinaryIO) -> list[_Page]:
    """The pages of a file, from its beginning to the first byte that is none."""
    pages: list[_Page] = []
    at, size = len(_MAGIC), os.fstat(file.fileno()).st_size
    while at < size:
        file.seek(at)
        try:
            page = _page(at, *read_struct(file.read(_MAX_HEADER_BYTES)))
        except (ThriftError, AttributeError, TypeError):
            break
        if page.start + page.stored > size:
            break
        pages.append(page)
        at = page.start + page.stored
    return pages


def _page(start: int, header: Struct, header_bytes: int) -> _Page:
    kind = header.value(1)
    details = header.value({_DATA_PAGE: 5, _DICTIONARY_PAGE: 7, _DATA_PAGE_V2: 8}.get(kind, -1))
    inflated, stored, n_values = header.value(2), header.value(3), details.value(1)
    if not all(isinstance(number, int) and number >= 0 for number in (inflated, stored, n_values)):
        raise ThriftError("it is not a page")
    return _Page(start, header_bytes + stored, header_bytes + inflated, kind == _DICTIONARY_PAGE, n_values)


_Chunks = list[list[_Page]]


def _row_groups(pages: list[_Page], values_per_row: list[int]) -> list[tuple[int, _Chunks]]:
    """Cuts the pages into row groups, and these into columns: for each its number of rows and its columns' pages."""
    groups: list[tuple[int, _Chunks]] = []
    at = 0
    while (found := _next_row_group(pages, at, values_per_row)) is not None:
        groups.append(found)
        at += sum(len(chunk) for chunk in found[1])
    return groups


def _next_row_group(pages: list[_Page], start: int, values_per_row: list[int]) -> tuple[int, _Chunks] | None:
    """The row group that begins at a page. How many rows it has, its first column tells in one of a few ways."""
    n_values = 0
    for at in range(start, min(start + _MOST_PAGES, len(pages))):
        if pages[at].is_dictionary:
            if at > start:
                return None
            continue
        n_values += pages[at].n_values
        n_rows, rest = divmod(n_values, values_per_row[0])
        chunks = None if rest or not n_rows else _columns(pages, start, n_rows, values_per_row)
        if chunks is not None:
            return n_rows, chunks
    return None


def _columns(pages: list[_Page], at: int, n_rows: int, values_per_row: list[int]) -> _Chunks | None:
    chunks: _Chunks = []
    for size in values_per_row:
        chunk: list[_Page] = []
        n_values = 0
        while n_values < n_rows * size:
            if at == len(pages) or (pages[at].is_dictionary and chunk):
                return None
            chunk.append(pages[at])
            n_values += 0 if pages[at].is_dictionary else pages[at].n_values
            at += 1
        if n_values != n_rows * size:
            return None
        chunks.append(chunk)
    return chunks


def _row_group(columns: list[Struct], n_rows: int, chunks: _Chunks) -> Struct:
    described = []
    for column, chunk in zip(columns, chunks, strict=True):
        details = Struct({field: value for field, value in column.items() if field in (1, 2, 3, 4)})
        data = [page for page in chunk if not page.is_dictionary]
        details[5] = (I64, sum(page.n_values for page in data))
        details[6] = (I64, sum(page.inflated for page in chunk))
        details[7] = (I64, sum(page.stored for page in chunk))
        details[9] = (I64, data[0].start)
        if chunk[0].is_dictionary:
            details[11] = (I64, chunk[0].start)
        described.append(Struct({2: (I64, 0), 3: (STRUCT, details)}))
    size = sum(page.inflated for chunk in chunks for page in chunk)
    return Struct({1: (LIST, Elements(STRUCT, described)), 2: (I64, size), 3: (I64, n_rows)})


def read_struct(data: bytes) -> tuple[Struct, int]:
    """Reads the structure that some bytes begin with.

    Returns:
        The structure, and how many bytes it takes.

    Raises:
        ThriftError: There is none.
    """
    stream = io.BytesIO(data)
    try:
        return _read_struct(stream), stream.tell()
    except (IndexError, OverflowError, RecursionError) as error:
        raise ThriftError("the structure is cut off") from error


def write_struct(struct: Struct) -> bytes:
    """The bytes of a structure. In parquet the numbers of two neighbouring fields are never more than 15 apart."""
    out = bytearray()
    last = 0
    for field in sorted(struct):
        kind, value = struct[field]
        out.append(field - last << 4 | kind)
        if kind not in (BOOL_TRUE, BOOL_FALSE):  # their type says it all
            out += _write_value(kind, value)
        last = field
    out.append(0)
    return bytes(out)


def _read_struct(stream: io.BytesIO) -> Struct:
    struct, last = Struct(), 0
    while head := stream.read(1)[0]:
        kind, delta = head & 15, head >> 4
        last = last + delta if delta else _read_integer(stream)
        is_bool = kind in (BOOL_TRUE, BOOL_FALSE)
        struct[last] = (kind, kind == BOOL_TRUE if is_bool else _read_value(kind, stream))
    return struct


def _read_value(kind: int, stream: io.BytesIO) -> Any:
    if kind in (I16, I32, I64):
        return _read_integer(stream)
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return stream.read(1)[0]
    if kind == BINARY:
        size = _read_varint(stream)
        value = stream.read(size)
        if len(value) < size:
            raise ThriftError("a value is longer than the file")
        return value
    if kind == LIST:
        head = stream.read(1)[0]
        size = head >> 4 if head >> 4 != 15 else _read_varint(stream)
        return Elements(head & 15, [_read_value(head & 15, stream) for _ in range(size)])
    if kind == STRUCT:
        return _read_struct(stream)
    raise ThriftError(f"type {kind} does not occur in parquet")


def _write_value(kind: int, value: Any) -> bytes:
    if kind in (I16, I32, I64):
        return _varint((value << 1) ^ (value >> 63))
    if kind in (BYTE, BOOL_TRUE, BOOL_FALSE):
        return bytes([value])
    if kind == BINARY:
        return _varint(len(value)) + value
    if kind == LIST:
        size = len(value.values)
        head = bytes([size << 4 | value.type]) if size < 15 else bytes([0xF0 | value.type]) + _varint(size)
        return head + b"".join(_write_value(value.type, element) for element in value.values)
    return write_struct(value)  # nothing else was read


def _read_integer(stream: io.BytesIO) -> int:
    number = _read_varint(stream)
    return (number >> 1) ^ -(number & 1)


def _read_varint(stream: io.BytesIO) -> int:
    number = 0
    for shift in range(0, 64, 7):
        byte = stream.read(1)[0]
        number |= (byte & 127) << shift
        if byte < 128:
            return number
    raise ThriftError("a number has more than 64 bits")


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    out.append(number)
    return bytes(out)
