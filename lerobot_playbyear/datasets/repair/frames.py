"""The frames of a dataset: which rows of which data file can be read, and which episode they belong to."""

import io
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.utils import DatasetInfo
from PIL import Image, UnidentifiedImageError

from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.parquet_files import ParquetDamageError, open_checked, read_row_groups
from lerobot_playbyear.datasets.repair.data_file import INDEX_COLUMNS, DataFile, open_source, read_indices
from lerobot_playbyear.datasets.repair.features import check_columns, own_schema
from lerobot_playbyear.datasets.repair.findings import Finding, State, Thing
from lerobot_playbyear.datasets.repair.rescue import rescue
from lerobot_playbyear.datasets.repair.rescued_file import RescuedFile


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


@dataclass(frozen=True)
class Frames:
    """What can be read of a dataset's frames.

    Args:
        runs: The rows of all data files.
        frame_seconds: The time between two frames; None where there are not two frames.
        findings: What was found wrong.
    """

    runs: tuple[Run, ...]
    frame_seconds: float | None
    findings: tuple[Finding, ...]


def read_frames(root: Path, info: DatasetInfo, thorough: bool) -> Frames:
    """Goes through all data files.

    Args:
        root: The dataset's folder.
        info: What the dataset says about itself.
        thorough: Read everything, with checksums, and look at every picture; otherwise only the index columns.

    Raises:
        OSError: A file cannot be read now.
    """
    schema = get_hf_features_from_features(info.features).arrow_schema
    pictures = [key for key, feature in info.features.items() if feature["dtype"] == "image"] if thorough else []
    findings: list[Finding] = []
    sizes: set[tuple[str, tuple[int, int]]] = set()
    runs: list[Run] = []
    steps: list[float] = []
    for path in list_files(root, "data/*/*.parquet"):
        name = path.relative_to(root)
        source = _find_source(path, name, schema)
        if isinstance(source, Finding):
            findings.append(source)
            continue
        rows = _read_rows(source, path, None if thorough else INDEX_COLUMNS, pictures)
        own, own_steps = _runs(DataFile(name, source, source == path and not rows.problems, rows.n_rows), rows)
        killed = f"{name} has no valid end, as if the recording had been killed: read from its beginning"
        said = [] if source == path else [killed]
        said += [f"{name}: {problem}" for problem in rows.problems]
        said += [
            f"{name}: the frames of episode {run.episode} are not numbered one after the other in 'index'"
            for run in own
            if not run.is_numbered
        ]
        findings += [Finding(Thing.FILE, State.DAMAGED, one) for one in said]
        sizes |= rows.sizes
        runs += own
        steps += own_steps
    findings += _check_shapes(info, sizes)
    return Frames(tuple(runs), float(np.median(steps)) if steps else None, tuple(findings))


def _check_shapes(info: DatasetInfo, sizes: Iterable[tuple[str, tuple[int, int]]]) -> list[Finding]:
    other = {key: size for key, size in sorted(sizes) if size not in itertools.pairwise(info.features[key]["shape"])}
    return [
        Finding(
            Thing.FEATURE,
            State.UNDECIDED,
            f"meta/info.json: '{key}' has shape {tuple(info.features[key]['shape'])}, but there are pictures {height} high "
            f"and {width} wide. Correct the shape if these are right",
        )
        for key, (height, width) in other.items()
    ]


def _find_source(path: Path, name: Path, schema: pa.Schema) -> Path | RescuedFile | Finding:
    """The file itself, or what can be rescued of it; or why nothing can."""
    try:
        with open_checked(path) as file:
            problem = check_columns(file.schema_arrow, schema)
        if problem is None:
            return path
        if own_schema(path) is not None:
            remedy = "Correct the features in meta/info.json, or take the file away"
            return Finding(Thing.FILE, State.UNDECIDED, f"{name}: {problem}. {remedy}")
    except ParquetDamageError as error:
        problem = str(error)
    said = f"{name} cannot be read: {problem}, and no complete episode could be found in it"
    return rescue(path, schema) or Finding(Thing.FILE, State.DAMAGED, said)


@dataclass(frozen=True)
class _Rows:
    """The rows of a file that can be read: their index columns, which have a damaged picture, and what is wrong; and for
    each camera the sizes of its pictures."""

    index: dict[str, np.ndarray]
    n_rows: int
    spoilt: dict[int, str]
    problems: tuple[str, ...]
    sizes: set[tuple[str, tuple[int, int]]]


def _read_rows(source: Path | RescuedFile, path: Path, columns: list[str] | None, pictures: list[str]) -> _Rows:
    parts: list[dict[str, np.ndarray]] = []
    spoilt: dict[int, str] = {}
    sizes: set[tuple[str, tuple[int, int]]] = set()
    problems: list[str] = []
    n_rows = 0
    with open_source(source) as opened:
        for number, table in enumerate(read_row_groups(opened, columns, path)):
            found = table if isinstance(table, ParquetDamageError) else read_indices(table)
            if isinstance(table, ParquetDamageError) or isinstance(found, ParquetDamageError):
                problems.append(f"row group {number} is damaged: {found}")
                continue
            parts.append(found)
            for key in pictures:
                for row, seen in _look_at_pictures(table.column(key), key):
                    if isinstance(seen, str):
                        spoilt[n_rows + row] = seen
                    else:
                        sizes.add((key, seen))
            n_rows += len(table)
    if spoilt:
        problems.append(f"{len(spoilt)} pictures are damaged")
    index = {name: np.concatenate([part[name] for part in parts]) for name in INDEX_COLUMNS} if parts else {}
    return _Rows(index, n_rows, spoilt, tuple(problems), sizes)


def _runs(file: DataFile, rows: _Rows) -> tuple[list[Run], list[float]]:
    """A file's rows, cut where another episode begins or frames are missing, and the times between them [s]."""
    index = rows.index
    if not rows.n_rows:
        return [], []
    breaks = (np.diff(index["episode_index"]) != 0) | (np.diff(index["frame_index"]) != 1)
    starts = [0, *(np.flatnonzero(breaks) + 1).tolist(), rows.n_rows]
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
            next((rows.spoilt[row] for row in range(start, stop) if row in rows.spoilt), None),
        )
        for start, stop in itertools.pairwise(starts)
    ]
    return runs, np.diff(index["timestamp"])[~breaks].tolist()


def _look_at_pictures(column: pa.ChunkedArray, key: str) -> Iterator[tuple[int, str | tuple[int, int]]]:
    """Of every picture in a column its row, and what is wrong with it, or its height and width."""
    for row, picture in enumerate(value.as_py() for value in column):
        try:
            if picture["bytes"] is not None:
                with Image.open(io.BytesIO(picture["bytes"])) as image:
                    image.verify()
                    yield row, (image.height, image.width)
        except UnidentifiedImageError:
            yield row, f"a picture of '{key}' is damaged (it is none)"
        except (OSError, SyntaxError, ValueError, TypeError, Image.DecompressionBombError) as error:
            yield row, f"a picture of '{key}' is damaged ({error})"
