"""Reads parquet files that have lost their end: those of a recording that was killed, or cut off by a full disk.

A parquet file's footer says where everything is, and is written last. LeRobot writes it when the recording ends,
but it writes every episode's pages, with a header each, when the episode is saved. From these headers, and the
columns that the dataset's features demand, the footer is written anew; pyarrow then reads the file as usual.
"""

import io
import logging
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.files import naming
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, leaf_columns, parsing, writer_options
from lerobot_playbyear.datasets.repair import thrift
from lerobot_playbyear.datasets.repair.rescued_file import FileBytes, RescuedFile
from lerobot_playbyear.datasets.repair.thrift import Elements, Struct, ThriftError

logger = logging.getLogger(__name__)

_MAGIC = b"PAR1"
_DATA_PAGE, _DICTIONARY_PAGE, _DATA_PAGE_V2 = 0, 2, 3
_MAX_HEADER_BYTES = 2**16


@dataclass
class _Page:
    """One page: where it begins, its bytes with and without its header, and how many values it holds."""

    start: int
    stored: int
    inflated: int
    is_dictionary: bool
    n_values: int


def rescue(path: Path, schema: pa.Schema) -> RescuedFile | None:
    """A way to read a parquet file without a valid footer.

    Args:
        path: The damaged file.
        schema: The columns that it should have, in any order that LeRobot or we write: the schema's.

    Returns:
        The file with a footer that names every complete row group; None where there is none.

    Raises:
        OSError: The file cannot be read now.
    """
    with naming(path), path.open("rb") as file:
        pages = _pages(FileBytes(file))
    for template in _templates(schema):
        groups = _row_groups(pages, template)
        if groups:
            footer = Struct(template.footer)
            footer[3] = (thrift.I64, sum(n_rows for n_rows, _ in groups))
            footer[4] = (
                thrift.LIST,
                Elements(thrift.STRUCT, [_row_group(template, n_rows, chunks) for n_rows, chunks in groups]),
            )
            last = groups[-1][1][-1][-1]
            encoded = thrift.write_struct(footer)
            end = encoded + len(encoded).to_bytes(4, "little") + _MAGIC
            rescued = RescuedFile(path, last.start + last.stored, end)
            try:
                with parsing(path):
                    pq.ParquetFile(rescued.open())
            except ParquetDamageError as error:
                logger.debug("%s: the footer that was made for it is not accepted: %s", path, error)
                continue
            return rescued
    return None


@dataclass
class _Template:
    """How a writer describes the columns.

    Args:
        footer: Of a file with one row.
        columns: Its columns' metadata.
        values_per_row: How many values of each column make a row.
    """

    footer: Struct
    columns: list[Struct]
    values_per_row: list[int]


def _templates(schema: pa.Schema) -> list[_Template]:
    """The footers of LeRobot's and our own writer for such columns."""
    sizes = [size for field in schema for size in _values_per_row(field.type)]
    if 0 in sizes:
        return []  # lists of no fixed length: where a row ends does not follow from the pages' headers
    templates = []
    for options in ({"compression": "snappy", "use_dictionary": True}, writer_options(schema)):
        # The lengths of lists stand in the schema alone, and may be those that a stranger claims: the row has short ones.
        short = pa.schema([field.with_type(_shortened(field.type)) for field in schema])
        row = pa.Table.from_arrays([_one_row(field.type) for field in short], schema=short)
        chunks = _footer(row, options).value(4).values[0].value(1).values
        footer = _footer(schema.empty_table(), options)
        templates.append(_Template(footer, [chunk.value(3) for chunk in chunks], sizes))
    return templates


def _footer(table: pa.Table, options: dict) -> Struct:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, **options)
    data = buffer.getvalue()
    footer, _ = thrift.read_struct(data, len(data) - 8 - int.from_bytes(data[-8:-4], "little"))
    return footer


def _shortened(kind: pa.DataType) -> pa.DataType:
    """A type of lists with one value each: its columns are described alike."""
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(kind.value_field.with_type(_shortened(kind.value_type)), 1)
    return kind


def _values_per_row(kind: pa.DataType) -> list[int]:
    """How many values each of a column's parquet columns has per row; 0 where that varies."""
    if isinstance(kind, pa.BaseExtensionType):
        kind = kind.storage_type
    if pa.types.is_fixed_size_list(kind):
        return [kind.list_size * size for size in _values_per_row(kind.value_type)]
    if pa.types.is_struct(kind):
        return [size for field in kind for size in _values_per_row(field.type)]
    return [0 if nested else 1 for _, _, nested in leaf_columns("", kind)]


def _one_row(kind: pa.DataType) -> pa.Array:
    """A row of nulls, or of lists of nulls: enough to have the column described."""
    return (
        pa.nulls(1, kind)
        if not isinstance(kind, pa.BaseExtensionType)
        else kind.wrap_array(pa.nulls(1, kind.storage_type))
    )


def _pages(data: FileBytes) -> list[_Page]:
    """The pages of a file, from its beginning to the first byte that is none."""
    pages: list[_Page] = []
    at = len(_MAGIC)
    while at < len(data):
        try:
            header, body = thrift.read_struct(data[at : at + _MAX_HEADER_BYTES])
            page = _page(header, at, body)
        except (ThriftError, AttributeError, TypeError):
            break
        if page is None or page.start + page.stored > len(data):
            break
        pages.append(page)
        at = page.start + page.stored
    return pages


def _page(header: Struct, start: int, header_bytes: int) -> _Page | None:
    kind, inflated, stored = header.value(1), header.value(2), header.value(3)
    details = header.value({_DATA_PAGE: 5, _DICTIONARY_PAGE: 7, _DATA_PAGE_V2: 8}.get(kind, -1))
    if not isinstance(details, Struct) or not isinstance(inflated, int) or not isinstance(stored, int) or stored < 0:
        return None
    n_values = details.value(1)
    if not isinstance(n_values, int) or n_values < 0:
        return None
    return _Page(start, header_bytes + stored, header_bytes + inflated, kind == _DICTIONARY_PAGE, n_values)


_Chunks = list[list[_Page]]


def _row_groups(pages: list[_Page], template: _Template) -> list[tuple[int, _Chunks]]:
    """Cuts the pages into row groups, and these into columns: for each its number of rows and its columns' pages."""
    groups: list[tuple[int, _Chunks]] = []
    at = 0
    while at < len(pages):
        found = _next_row_group(pages, at, template.values_per_row)
        if found is None:
            break
        groups.append(found)
        at += sum(len(chunk) for chunk in found[1])
    return groups


def _next_row_group(pages: list[_Page], start: int, values_per_row: list[int]) -> tuple[int, _Chunks] | None:
    """The row group that begins at a page. How many rows it has, its first column tells in one of a few ways."""
    n_values = 0
    for at in range(start, len(pages)):
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


def _row_group(template: _Template, n_rows: int, chunks: _Chunks) -> Struct:
    columns = []
    for column, chunk in zip(template.columns, chunks, strict=True):
        details = Struct({field: value for field, value in column.items() if field in (1, 2, 3, 4)})
        data = [page for page in chunk if not page.is_dictionary]
        details[5] = (thrift.I64, sum(page.n_values for page in data))
        details[6] = (thrift.I64, sum(page.inflated for page in chunk))
        details[7] = (thrift.I64, sum(page.stored for page in chunk))
        details[9] = (thrift.I64, data[0].start)
        if chunk[0].is_dictionary:
            details[11] = (thrift.I64, chunk[0].start)
        columns.append(Struct({2: (thrift.I64, 0), 3: (thrift.STRUCT, details)}))
    size = sum(page.inflated for chunk in chunks for page in chunk)
    return Struct(
        {
            1: (thrift.LIST, Elements(thrift.STRUCT, columns)),
            2: (thrift.I64, size),
            3: (thrift.I64, n_rows),
        }
    )
