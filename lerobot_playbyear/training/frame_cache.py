"""The columns of a dataset as files that are mapped into memory: decoded once, found again by every later run.

A folder of the cache holds one set of columns. Its name is a digest of everything that they depend on, the stamps of the
dataset's files included, so that a dataset that changed has another folder. A column is there whole or not at all: what was
cut off is decoded again.
"""

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, flush
from lerobot_playbyear.datasets.info import file_inside
from lerobot_playbyear.datasets.reader import TOLERANCE_S, DatasetReader

DEFAULT_CACHE = HF_LEROBOT_HOME.with_name("lerobot_playbyear")
"""Where the columns are kept: beside LeRobot's own cache."""

Pieces = Callable[[str], Iterator[np.ndarray]]
"""Gives a column in pieces (n, ...); what is wrong with it is an error."""

_SPARE_BYTES = 2**28

logger = logging.getLogger(__name__)


class CacheError(InputError):
    """The columns cannot be kept on the disk; the message says why, and what to do."""


def cached_columns(
    identity: Mapping[str, Any], row_bytes: Mapping[str, int], n_rows: int, pieces: Pieces, cache: Path | None = None
) -> dict[str, Tensor]:
    """Maps the columns of a dataset; those that no earlier run has made are made first.

    Args:
        identity: Everything that the columns depend on, as JSON takes it.
        row_bytes: The columns wanted, and how large a row of each is at most.
        n_rows: Of each column, N.
        pieces: Gives a column's rows.
        cache: The folder of all such files; None takes `DEFAULT_CACHE`.

    Returns:
        Each column, (N, ...), read-only. Other processes that map it share its memory.

    Raises:
        CacheError: There is no room on the disk, or it cannot be written.
        ValueError: Whatever `pieces` says of the dataset.
    """
    cache = (cache or DEFAULT_CACHE).expanduser().absolute()
    content = json.dumps([identity, list(row_bytes), n_rows], sort_keys=True)
    folder = cache / hashlib.blake2b(content.encode(), digest_size=16).hexdigest()
    files = {key: folder / f"{number}.npy" for number, key in enumerate(row_bytes)}
    with _telling(cache):
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock", thread_local=False):  # others wait; it ends with its process
            found = {key: _mapped(path, n_rows) for key, path in files.items()}
            missing = {key: files[key] for key, column in found.items() if column is None}
            _check_room(folder, sum(row_bytes[key] for key in missing) * n_rows)
            with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # what fails cancels what has not begun
                list(pool.map(lambda key: _write_column(files[key], key, n_rows, pieces), missing))
            found |= {key: _mapped(path, n_rows) for key, path in missing.items()}
    return {key: column for key, column in found.items() if column is not None}


def dataset_identity(reader: DatasetReader, features: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that the values of some features depend on, as JSON takes it.

    A file is known by its place, its size and its times. The time of change (ctime) cannot be set: who writes new content and
    restores the other times changes it.

    Args:
        reader: Of the dataset; its episodes count, in their order.
        features: The features that matter.

    Raises:
        ValueError: A file lies outside the dataset's folder.
        OSError: A file is not there.
    """
    root, meta = reader.root, reader.meta
    episodes = [episode.index for episode in reader.episodes]
    cameras = [key for key, feature in features.items() if feature["dtype"] == "video"]
    names = {str(meta.get_data_file_path(episode)) for episode in episodes}
    names |= {str(meta.get_video_file_path(episode, key)) for episode in episodes for key in cameras}
    if any(feature["dtype"] == "image" for feature in features.values()):
        names |= {path.relative_to(root).as_posix() for path in root.glob("images/**/*") if path.is_file()}
    stats = {name: file_inside(root, name).stat() for name in sorted(names)}
    return {
        "root": str(root.resolve()),
        "features": json.loads(json.dumps(features, default=str)),
        "fps": reader.fps,
        "tolerance_s": TOLERANCE_S,
        "episodes": episodes,
        "video_starts": {key: [meta.episodes[i][f"videos/{key}/from_timestamp"] for i in episodes] for key in cameras},
        "files": {name: [s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino] for name, s in stats.items()},
    }


@contextlib.contextmanager
def _telling(cache: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise CacheError(
                f"The disk of '{cache}' became full; columns that were complete stay, and the next run goes on with them. Make "
                "room, or name a folder on another disk with --store.cache."
            ) from error
        named = Path(str(error.filename))
        if not (named.is_relative_to(cache) or cache.is_relative_to(named)):
            raise  # the dataset cannot be read now, which another folder would not mend
        raise CacheError(f"'{cache}' cannot be used ({error}): name another folder with --store.cache.") from error


def _mapped(path: Path, n_rows: int) -> Tensor | None:
    """A column that was finished; None where there is none, or something happened to it since."""
    try:
        column = np.load(path, mmap_mode="r", allow_pickle=False)
        if len(column) != n_rows:
            raise ValueError(f"it has {len(column)} rows, and the dataset {n_rows}")
    except FileNotFoundError:
        return None
    except (ValueError, EOFError) as error:  # shortened since, or another program's
        logger.warning(f"'{path}' is damaged ({error}), and is made again.")
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that the tensor could be written to, which nothing here does
        return torch.from_numpy(column)


def _check_room(folder: Path, wanted: int) -> None:
    free = shutil.disk_usage(folder).free
    if wanted and wanted + _SPARE_BYTES > free:
        raise CacheError(
            f"The decoded frames need {wanted / 2**30:.1f} GiB on the disk of '{folder.parent}', and "
            f"{free / 2**30:.1f} GiB are free. Make room (folders of other datasets in there may go), choose fewer "
            "episodes (--dataset.episodes), or name a folder on another disk with --store.cache."
        )


def _write_column(path: Path, key: str, n_rows: int, pieces: Pieces) -> None:
    """The rows get the column's name when all of them are on the disk, and `pieces` has ended without an error."""
    part, done = path.with_suffix(".part"), 0
    with part.open("wb") as file:
        for piece in pieces(key):
            if not done:
                header = {"descr": piece.dtype.str, "fortran_order": False, "shape": (n_rows, *piece.shape[1:])}
                np.lib.format.write_array_header_1_0(file, header)
            file.write(np.ascontiguousarray(piece).data)
            done += len(piece)
    flush(part)
    if done != n_rows:
        raise ValueError(f"'{key}' has {done} rows, and the dataset {n_rows}: playbyear-repair looks into it.")
    part.replace(path)
    flush(path.parent)
