"""The frames of a dataset: which rows of which data file can be read, and which episode they belong to."""

import errno
import io
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DatasetInfo
from PIL import Image, UnidentifiedImageError

from lerobot_playbyear.datasets.columns import column_to_numpy
from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import (
    ParquetDamageError,
    open_checked,
    open_parquet,
    parsing,
    read_row_groups,
)
from lerobot_playbyear.datasets.repair.features import check_columns
from lerobot_playbyear.datasets.repair.rescue import RescuedFile, rescue

INDEX_COLUMNS = ["episode_index", "frame_index", "index", "task_index", "timestamp"]


@dataclass
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
    n_rows: int = 0

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
        with _open(self.source) as file:
            return file.schema_arrow

    @property
    def path(self) -> Path:
        """The file."""
        return self.source if isinstance(self.source, Path) else self.source.path

    def _parts(self) -> Iterator[pa.Table]:
        n_rows = 0
        with _open(self.source) as file:
            for table in read_row_groups(file, path=self.path):
                if not isinstance(table, ParquetDamageError) and not isinstance(_indices(table), ParquetDamageError):
                    n_rows += len(table)
                    yield table
        raise OSError(errno.EIO, f"{self.n_rows} of its rows could be read before, and now {n_rows}", str(self.name))


@dataclass
class Run:
    """Rows that follow each other and belong to one episode.

    Args:
        file: Where they are.
        start: The first row, counted among those that can be read.
        length: How many.
        episode: The episode's number.
        first_frame: The first row's frame number within the episode.
        first_index: The first row's frame number within the dataset.
        tasks: The numbers of the tasks that occur.
        damage: What is wrong with one of the rows; None for nothing.
    """

    file: DataFile
    start: int
    length: int
    episode: int
    first_frame: int
    first_index: int
    tasks: list[int]
    damage: str | None = None


@dataclass
class Frames:
    """What can be read of a dataset's frames.

    Args:
        files: The data files.
        runs: Their rows.
        frame_seconds: The time between two frames; None where there are not two frames.
    """

    files: list[DataFile]
    runs: list[Run]
    frame_seconds: float | None


def read_frames(root: Path, info: DatasetInfo, thorough: bool, findings: list[str]) -> Frames:
    """Goes through all data files.

    Args:
        root: The dataset's folder.
        info: What the dataset says about itself.
        thorough: Read everything, with checksums, and look at every picture; otherwise only the index columns.
        findings: Gets what was found wrong.

    Raises:
        OSError: A file cannot be read now.
    """
    schema = get_hf_features_from_features(info.features).arrow_schema
    pictures = [key for key, feature in info.features.items() if feature["dtype"] == "image"] if thorough else []
    files: list[DataFile] = []
    runs: list[Run] = []
    steps: list[float] = []
    for path in list_files(root, "data/*/*.parquet"):
        name = path.relative_to(root)
        try:
            file = _find_source(path, name, schema)
        except ParquetDamageError as error:
            findings.append(f"{name} cannot be read: {error}")
            continue
        if not file.is_whole:
            findings.append(f"{name} has no valid end, as if the recording had been killed: read from its beginning")
        own, own_steps = _read_file(file, None if thorough else INDEX_COLUMNS, pictures, findings)
        files.append(file)
        runs.extend(own)
        steps.extend(own_steps.tolist())
    return Frames(files, runs, float(np.median(steps)) if steps else None)


def _find_source(path: Path, name: Path, schema: pa.Schema) -> DataFile:
    """The file itself, or what can be rescued of it.

    Raises:
        ParquetDamageError: Nothing can.
    """
    try:
        with open_checked(path) as file:
            if problem := check_columns(file.schema_arrow, schema):
                raise ParquetDamageError(problem)
        return DataFile(name, path, is_whole=True)
    except ParquetDamageError as error:
        rescued = rescue(path, schema)
        if rescued is None:
            raise ParquetDamageError(f"{error}, and no complete episode could be found in it") from error
        return DataFile(name, rescued, is_whole=False)


def _read_file(
    file: DataFile, columns: list[str] | None, pictures: list[str], findings: list[str]
) -> tuple[list[Run], np.ndarray]:
    parts: list[dict[str, np.ndarray]] = []
    spoilt: dict[int, str] = {}
    n_rows = 0
    with _open(file.source) as opened:
        for number, table in enumerate(read_row_groups(opened, columns, file.path)):
            found = table if isinstance(table, ParquetDamageError) else _indices(table)
            if isinstance(table, ParquetDamageError) or isinstance(found, ParquetDamageError):
                findings.append(f"{file.name}: row group {number} is damaged: {found}")
                file.is_whole = False
                continue
            parts.append(found)
            for key in pictures:
                spoilt.update({n_rows + row: what for row, what in _spoilt_pictures(table.column(key), key)})
            n_rows += len(table)
    file.n_rows = n_rows
    if spoilt:
        file.is_whole = False
        findings.append(f"{file.name}: {len(spoilt)} pictures are damaged")
    if not parts:
        return [], np.empty(0)
    index = {name: np.concatenate([part[name] for part in parts]) for name in INDEX_COLUMNS}
    breaks = (np.diff(index["episode_index"]) != 0) | (np.diff(index["frame_index"]) != 1)
    starts = [0, *(np.flatnonzero(breaks) + 1).tolist(), n_rows]
    runs = [
        Run(
            file,
            start,
            stop - start,
            int(index["episode_index"][start]),
            int(index["frame_index"][start]),
            int(index["index"][start]),
            np.unique(index["task_index"][start:stop]).tolist(),
            next((spoilt[row] for row in range(start, stop) if row in spoilt), _jump(index["index"][start:stop])),
        )
        for start, stop in itertools.pairwise(starts)
    ]
    return runs, np.diff(index["timestamp"])[~breaks]


def _indices(table: pa.Table) -> dict[str, np.ndarray] | ParquetDamageError:
    """The index columns; where a number is missing, which rows these are is not known, and nothing of them is used."""
    try:
        return {name: column_to_numpy(table.column(name)) for name in INDEX_COLUMNS}
    except ValueError as error:
        return ParquetDamageError(str(error))


def _jump(index: np.ndarray) -> str | None:
    return None if (np.diff(index) == 1).all() else "its frames are not numbered one after the other"


def _spoilt_pictures(column: pa.ChunkedArray, key: str) -> list[tuple[int, str]]:
    spoilt = []
    for row, picture in enumerate(value.as_py() for value in column):
        try:
            if picture["bytes"] is not None:
                with Image.open(io.BytesIO(picture["bytes"])) as image:
                    image.verify()
        except UnidentifiedImageError:
            spoilt.append((row, f"a picture of '{key}' is damaged (it is none)"))
        except (OSError, SyntaxError, ValueError, TypeError, Image.DecompressionBombError) as error:
            spoilt.append((row, f"a picture of '{key}' is damaged ({error})"))
    return spoilt


def _open(source: Any) -> pq.ParquetFile:
    if isinstance(source, Path):
        return open_checked(source)
    with parsing(source.path):
        return open_parquet(source.open())
