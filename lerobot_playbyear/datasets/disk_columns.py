"""The columns of a dataset as files that are mapped into memory: decoded once, found again by every later run.

A folder of the cache holds one set of columns. Its name is a digest of everything that they depend on, the content of
the dataset's files included, so that a dataset that changed has another folder. The folder is made under another name and
gets its own when all of it is on the disk: what was cut off is never read, and the next run goes on with it.
"""

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, flush

DEFAULT_CACHE = HF_LEROBOT_HOME.with_name("lerobot_playbyear")
"""Where the columns are kept: beside LeRobot's own cache."""

Pieces = Callable[[str, int], Iterator[np.ndarray]]
"""Gives a column from a row on, in pieces (n, ...); what is wrong with an earlier row, too, is an error."""

_FORMAT = 1
_MANIFEST, _PART, _ROWS = "manifest.json", ".part", ".rows"
_SAVED_EVERY_S = 5.0
_SPARE_BYTES = 2**28

logger = logging.getLogger(__name__)


class CacheError(InputError):
    """The columns cannot be kept on the disk; the message says why, and what to do."""


def disk_columns(
    identity: Mapping[str, Any], row_bytes: Mapping[str, int], n_rows: int, pieces: Pieces, cache: Path | None = None
) -> dict[str, Tensor]:
    """Maps the columns of a dataset; where no earlier run has made their files they are made first.

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
    cache = (cache or DEFAULT_CACHE).expanduser()
    content = json.dumps([_FORMAT, identity, list(row_bytes), n_rows], sort_keys=True)
    folder = cache / hashlib.blake2b(content.encode(), digest_size=16).hexdigest()
    with _telling(cache):
        cache.mkdir(parents=True, exist_ok=True)
        with _alone(folder):
            columns = _open(folder, list(row_bytes), n_rows)
            if columns is None:
                _check_room(folder, sum(row_bytes.values()) * n_rows)
                _make(folder, list(row_bytes), n_rows, pieces)
                columns = _open(folder, list(row_bytes), n_rows)
    if columns is None:
        raise CacheError(f"'{folder}' was made and is gone again: does another program empty '{cache}'?")
    return columns


@contextlib.contextmanager
def _telling(cache: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise CacheError(
                f"The disk of '{cache}' became full; what was decoded stays, and the next run goes on with it. Make room, "
                "or name a folder on another disk with --store.cache."
            ) from error
        if not _concerns(error, cache):  # the dataset cannot be read now, which another folder would not mend
            raise
        raise CacheError(f"'{cache}' cannot be used ({error}): name another folder with --store.cache.") from error


def _concerns(error: OSError, cache: Path) -> bool:
    """Whether an error is about the cache's folder, something in it, or a folder that it lies in."""
    if not isinstance(error.filename, str | os.PathLike):
        return False
    path = Path(error.filename)
    return path == cache or cache in path.parents or path in cache.parents


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """One process makes the files, and the others wait for it. The lock ends with the process that holds it."""
    lock = FileLock(f"{folder}.lock", thread_local=False)
    try:
        lock.acquire(timeout=1)
    except Timeout:
        logger.info(f"Another process is filling '{folder}': waiting for it.")
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _open(folder: Path, keys: list[str], n_rows: int) -> dict[str, Tensor] | None:
    """The columns of a finished folder; None where there is none. What was finished and does not fit is removed."""
    try:
        manifest = json.loads((folder / _MANIFEST).read_text())
        columns = {key: np.load(folder / manifest["files"][key], mmap_mode="r", allow_pickle=False) for key in keys}
        if any(len(column) != n_rows for column in columns.values()):
            raise ValueError("a column has another number of rows than the dataset")
    except FileNotFoundError:
        if not folder.exists():
            return None
        reason = "a file is gone"
    except (ValueError, KeyError, EOFError) as error:  # shortened since, or another program's
        reason = str(error)
    else:
        logger.info(f"Columns of an earlier run, {folder}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that the tensor could be written to, which nothing here does
            return {key: torch.from_numpy(column) for key, column in columns.items()}
    logger.warning(f"'{folder}' is damaged ({reason}), and is made anew.")
    shutil.rmtree(folder)
    return None


def _check_room(folder: Path, wanted: int) -> None:
    part = _part(folder)
    there = sum(path.stat().st_size for path in part.iterdir()) if part.is_dir() else 0
    free = shutil.disk_usage(folder.parent).free
    if wanted - there + _SPARE_BYTES > free:
        raise CacheError(
            f"The decoded frames need {(wanted - there) / 2**30:.1f} GiB on the disk of '{folder.parent}', and "
            f"{free / 2**30:.1f} GiB are free. Make room (folders of other datasets in there may go), choose fewer "
            "episodes (--dataset.episodes), or name a folder on another disk with --store.cache."
        )


def _make(folder: Path, keys: list[str], n_rows: int, pieces: Pieces) -> None:
    """Writes all columns, several at a time, and gives the folder its name."""
    part = _part(folder)
    part.mkdir(exist_ok=True)
    files = {key: f"{number}.npy" for number, key in enumerate(keys)}
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        goes_on = Event()
        goes_on.set()
        try:
            for _ in pool.map(lambda key: _write_column(part / files[key], key, n_rows, pieces, goes_on), keys):
                pass
        finally:
            goes_on.clear()  # of the others, where one failed or a person pressed Ctrl-C
    if not all(_safe_rows((part / name).with_suffix(_ROWS))[0] == n_rows for name in files.values()):
        raise CacheError(f"'{part}' was written by another program at the same time: empty '{folder.parent}'.")
    for path in part.glob(f"*{_ROWS}"):
        path.unlink()
    _write_whole(part / _MANIFEST, json.dumps({"format": _FORMAT, "rows": n_rows, "files": files}))
    flush(part)
    part.rename(folder)
    flush(folder.parent)


def _part(folder: Path) -> Path:
    return folder.with_name(folder.name + _PART)


def _write_column(path: Path, key: str, n_rows: int, pieces: Pieces, goes_on: Event) -> None:
    """Appends what is missing. How many rows are safe on the disk stands in a file beside it.

    All rows are safe only when `pieces` has ended without an error: what is wrong with a column it may say last. A column
    that an earlier run completed is asked once more, for what it says of the rows that are there.
    """
    safe = path.with_suffix(_ROWS)
    first, row_bytes = _safe_rows(safe)
    done = first
    saved = time.monotonic()
    with path.open("r+b" if done else "wb") as file:
        if done:
            file.seek(_header_bytes(file) + done * row_bytes)
            file.truncate()
        for piece in pieces(key, done):
            if not goes_on.is_set():
                return
            if not done:
                header = {"descr": piece.dtype.str, "fortran_order": False, "shape": (n_rows, *piece.shape[1:])}
                np.lib.format.write_array_header_1_0(file, header)
            file.write(np.ascontiguousarray(piece).data)
            done, row_bytes = done + len(piece), piece.nbytes // len(piece)
            if time.monotonic() - saved > _SAVED_EVERY_S and done < n_rows:
                _save(file, safe, done, row_bytes)
                saved = time.monotonic()
        if done == n_rows != first:
            _save(file, safe, done, row_bytes)
    if done != n_rows:
        raise ValueError(f"'{key}' has {done} rows, and the dataset {n_rows}: playbyear-repair looks into it.")


def _save(file: BinaryIO, safe: Path, done: int, row_bytes: int) -> None:
    file.flush()
    os.fsync(file.fileno())
    _write_whole(safe, json.dumps([done, row_bytes]))


def _safe_rows(path: Path) -> tuple[int, int]:
    try:
        done, row_bytes = json.loads(path.read_text())
    except FileNotFoundError:
        return 0, 0
    return done, row_bytes


def _header_bytes(file: BinaryIO) -> int:
    np.lib.format.read_magic(file)
    np.lib.format.read_array_header_1_0(file)
    return file.tell()


def _write_whole(path: Path, text: str) -> None:
    """Replaces a small file, so that it is whole whenever it is read."""
    new = path.with_suffix(".new")
    with new.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
