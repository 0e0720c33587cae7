"""A file with frames, as far as it can be read."""

import errno
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.parquet_files import (
    ParquetDamageError,
    open_checked,
    open_parquet,
    parsing,
    read_row_groups,
)
from lerobot_playbyear.datasets.repair.rescued_file import RescuedFile

INDEX_COLUMNS = ["episode_index", "frame_index", "index", "task_index", "timestamp"]


@dataclass(frozen=True)
class DataFile:
    """A data file that can be read, at least in parts.

    Args:
        name: Relative to the dataset's folder.
        source: What is read: the file, or what of it can be read with a new footer.
        is_whole: Whether the file can be taken over as it is.
        n_rows: How many rows can be read.
    """

    name: Path
    source: Path | RescuedFile
    is_whole: bool
    n_rows: int

    def read(self, spans: Iterable[tuple[int, int]]) -> Iterator[tuple[int, pa.Table]]:
        """Some of the rows that can be read, in parts of bounded size; spans in the file's order are read in one go.

        Args:
            spans: First row and number of rows of each, counted among those that can be read.

        Returns:
            The span's place among the spans, and rows of it.

        Raises:
            OSError: They cannot be read now, or are others than they were.
        """
        parts: Iterator[pa.Table] = iter(())
        part, first = None, 0  # the rows that were read last, and the number of the first of them
        for place, (start, length) in enumerate(spans):
            if part is None or start < first:
                parts, first = self._parts(), 0
                part = next(parts)
            at = start
            while at < start + length:
                while at >= first + len(part):
                    first += len(part)
                    part = next(parts)
                rows = part.slice(at - first, start + length - at)
                yield place, rows
                at += len(rows)

    @property
    def schema(self) -> pa.Schema:
        """Of its columns."""
        with open_source(self.source) as file:
            return file.schema_arrow

    @property
    def path(self) -> Path:
        """The file."""
        return self.source if isinstance(self.source, Path) else self.source.path

    def _parts(self) -> Iterator[pa.Table]:
        n_rows = 0
        with open_source(self.source) as file:
            for table in read_row_groups(file, path=self.path):
                if not isinstance(table, ParquetDamageError) and not isinstance(
                    read_indices(table), ParquetDamageError
                ):
                    n_rows += len(table)
                    yield table
        raise OSError(errno.EIO, f"{self.n_rows} of its rows could be read before, and now {n_rows}", str(self.name))


def read_indices(table: pa.Table) -> dict[str, np.ndarray] | ParquetDamageError:
    """The index columns; where a number is missing, which rows these are is not known, and nothing of them is used."""
    try:
        return {name: column_to_numpy(table.column(name)) for name in INDEX_COLUMNS}
    except ValueError as error:
        return ParquetDamageError(str(error))


def open_source(source: Path | RescuedFile) -> pq.ParquetFile:
    """Opens a data file, or what of it can be read with a new footer. Raises as `open_checked`."""
    if isinstance(source, Path):
        return open_checked(source)
    with parsing(source.path):
        return open_parquet(source.open())
