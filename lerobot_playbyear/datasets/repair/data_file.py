"""A file with frames, as far as it can be read."""

import errno
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, read_row_groups

INDEX_COLUMNS = ["episode_index", "frame_index", "index", "task_index", "timestamp"]


@dataclass
class DataFile:
    """A data file that can be read, at least in parts.

    Args:
        name: Relative to the dataset's folder.
        path: Where it is.
        footer: What is taken for its footer; None: its own.
        is_whole: Whether the file can be taken over as it is.
        n_rows: How many rows can be read.
    """

    name: Path
    path: Path
    footer: pq.FileMetaData | None = None
    is_whole: bool = False
    n_rows: int = 0

    def parts(
        self, problems: list[str], columns: list[str] | None = None
    ) -> Iterator[tuple[pa.Table, dict[str, np.ndarray]]]:
        """The rows that can be read, in parts of bounded size, and their index columns.

        Where a number is missing, which rows these are is not known, and nothing of them is used.

        Args:
            problems: What is wrong with the others is added here.
            columns: Which to read; None: all.

        Raises:
            OSError: They cannot be read now.
        """
        with open_checked(self.path, self.footer) as file:
            for number, table in enumerate(read_row_groups(file, columns, self.path)):
                try:
                    if isinstance(table, ParquetDamageError):
                        raise table
                    index = {name: column_to_numpy(table.column(name)) for name in INDEX_COLUMNS}
                except ValueError as error:
                    problems.append(f"row group {number} is damaged: {error}")
                else:
                    yield table, index

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
                parts, first = self._tables(), 0
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
        with open_checked(self.path, self.footer) as file:
            return file.schema_arrow

    def _tables(self) -> Iterator[pa.Table]:
        n_rows = 0
        for table, _ in self.parts([]):
            n_rows += len(table)
            yield table
        raise OSError(errno.EIO, f"{self.n_rows} of its rows could be read before, and now {n_rows}", str(self.name))
