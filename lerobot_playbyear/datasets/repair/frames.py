"""The frames of a dataset: which rows of which data file can be read, and which episode they belong to."""

import errno
import io
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DatasetInfo
from PIL import Image, UnidentifiedImageError

from lerobot_playbyear.datasets.confines import PICTURE_FORMATS
from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet import ParquetDamageError, column_to_numpy, open_checked, read_row_groups
from lerobot_playbyear.datasets.repair.info import check_columns, own_schema
from lerobot_playbyear.datasets.repair.report import RepairReport
from lerobot_playbyear.datasets.repair.rescue import rescue

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

    def read(self, spans: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int, pa.Table]]:
        """Some of the rows that can be read, in parts of bounded size; spans in the file's order are read in one go.

        Args:
            spans: First row and number of rows of each, counted among those that can be read.

        Returns:
            The span's place among the spans, how many of its rows came before, and rows of it.

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
                yield place, at - start, rows
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


@dataclass(frozen=True)
class Run:
    """Rows that follow each other and belong to one episode.

    Args:
        file: Where they are.
        start: The first row, counted among those that can be read.
        length: How many.
        episode: The episode's number.
        first_frame: The first row's frame number within the episode.
        first_index: The first row's frame number within the dataset.
        is_numbered: Whether the other rows' follow from it.
        tasks: The numbers of the tasks that occur.
        damage: What is wrong with one of the rows; None for nothing.
    """

    file: DataFile
    start: int
    length: int
    episode: int
    first_frame: int
    first_index: int
    is_numbered: bool
    tasks: tuple[int, ...]
    damage: str | None = None


def read_frames(report: RepairReport, info: DatasetInfo, thorough: bool) -> tuple[list[Run], float | None]:
    """Goes through all data files.

    Args:
        report: Of the dataset; what is wrong is added.
        info: What the dataset says about itself.
        thorough: Read everything, with checksums, and look at every picture; otherwise only the index columns.

    Returns:
        The rows of all data files, and the time between two frames [s]; None where there are not two frames.

    Raises:
        OSError: A file cannot be read now.
    """
    schema = get_hf_features_from_features(info.features).arrow_schema
    pictures = [key for key, feature in info.features.items() if feature["dtype"] == "image"] if thorough else []
    sizes: dict[str, set[tuple[int, int]]] = {key: set() for key in pictures}
    runs: list[Run] = []
    steps: list[float] = []
    for path in list_files(report.root, "data/*/*.parquet"):
        file = _find_rows(report, path, schema)
        if file is not None:
            own, own_steps = _read_runs(report, file, None if thorough else INDEX_COLUMNS, sizes)
            runs += own
            steps += own_steps
    for key, seen in sorted(sizes.items()):
        shape = tuple(info.features[key]["shape"])
        for height, width in sorted(seen - set(itertools.pairwise(shape)))[-1:]:
            report.undecided.append(
                f"meta/info.json: '{key}' has shape {shape}, but there are pictures {height} high and {width} wide. "
                "Correct the shape if these are right"
            )
    return runs, float(np.median(steps)) if steps else None


def _find_rows(report: RepairReport, path: Path, schema: pa.Schema) -> DataFile | None:
    """The file as it is, or what can be rescued of it."""
    name = path.relative_to(report.root)
    try:
        with open_checked(path) as file:
            problem = check_columns(file.schema_arrow, schema)
        if problem is None:
            return DataFile(name, path)
        if own_schema(path) is not None:
            remedy = "Correct the features in meta/info.json, or take the file away"
            report.undecided.append(f"{name}: {problem}. {remedy}")
            return None
    except ParquetDamageError as error:
        problem = str(error)
    footer = rescue(path, schema)
    if footer is None:
        report.findings.append(f"{name} cannot be read: {problem}, and no complete episode could be found in it")
        return None
    report.findings.append(f"{name} has no valid end, as if the recording had been killed: read from its beginning")
    return DataFile(name, path, footer)


def _read_runs(
    report: RepairReport, file: DataFile, columns: list[str] | None, sizes: dict[str, set[tuple[int, int]]]
) -> tuple[list[Run], list[float]]:
    """A file's rows, cut where another episode begins or frames are missing, and the times between them [s].

    The sizes of the pictures are added to those of each camera.
    """
    parts: list[dict[str, np.ndarray]] = []
    spoilt: dict[int, str] = {}
    problems: list[str] = []
    for table, part in file.parts(problems, columns):
        parts.append(part)
        for key, own_sizes in sizes.items():
            for row, seen in _look_at_pictures(table.column(key), key):
                if isinstance(seen, str):
                    spoilt[file.n_rows + row] = seen
                else:
                    own_sizes.add(seen)
        file.n_rows += len(table)
    if spoilt:
        problems.append(f"{len(spoilt)} pictures are damaged")
    file.is_whole = file.footer is None and not problems
    report.findings += [f"{file.name}: {problem}" for problem in problems]
    if not file.n_rows:
        return [], []
    index = {name: np.concatenate([part[name] for part in parts]) for name in INDEX_COLUMNS}
    breaks = (np.diff(index["episode_index"]) != 0) | (np.diff(index["frame_index"]) != 1)
    starts = [0, *(np.flatnonzero(breaks) + 1).tolist(), file.n_rows]
    runs = [
        Run(
            file,
            start,
            stop - start,
            int(index["episode_index"][start]),
            int(index["frame_index"][start]),
            int(index["index"][start]),
            bool((np.diff(index["index"][start:stop]) == 1).all()),
            tuple(np.unique(index["task_index"][start:stop]).tolist()),
            next((spoilt[row] for row in range(start, stop) if row in spoilt), None),
        )
        for start, stop in itertools.pairwise(starts)
    ]
    report.findings += [
        f"{file.name}: the frames of episode {run.episode} are not numbered one after the other in 'index'"
        for run in runs
        if not run.is_numbered
    ]
    return runs, np.diff(index["timestamp"])[~breaks].tolist()


def _look_at_pictures(column: pa.ChunkedArray, key: str) -> Iterator[tuple[int, str | tuple[int, int]]]:
    """Of every picture in a column its row, and what is wrong with it, or its height and width."""
    for row, picture in enumerate(value.as_py() for value in column):
        try:
            if picture["bytes"] is not None:
                with Image.open(io.BytesIO(picture["bytes"]), formats=PICTURE_FORMATS) as image:
                    image.verify()
                    yield row, (image.height, image.width)
        except UnidentifiedImageError:
            yield row, f"a picture of '{key}' is damaged (it is none)"
        except (OSError, SyntaxError, ValueError, TypeError, Image.DecompressionBombError) as error:
            yield row, f"a picture of '{key}' is damaged ({error})"
