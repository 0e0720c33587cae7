"""Putting a repaired copy in the place of a dataset, so that at every moment one of the two is whole.

The copy is written beside the dataset, on its disk. Its last file is a mark that says what it is a copy of, and under
which name that is put aside: only a copy with this mark ever takes the dataset's place.
"""

import contextlib
import hashlib
import itertools
import json
import os
import shutil
from pathlib import Path

from lerobot_playbyear.datasets.files import entries_below, flush, flush_all, write_atomically
from lerobot_playbyear.datasets.journal import SCRATCH
from lerobot_playbyear.datasets.repair.report import DatasetDamagedError

_BEGUN = SCRATCH / ".repairing"
_FINISHED = SCRATCH / ".repaired.json"
MARKS = {_BEGUN.name, _FINISHED.name}


def begin_copy(root: Path) -> Path:
    """Makes the empty folder beside a dataset that its repaired copy is written to; what a killed repair left goes.

    Raises:
        DatasetDamagedError: A folder of this name is not known to be a copy that is no longer needed.
        OSError: It cannot be made.
    """
    real = root.resolve()
    copy = _copy_of(real)
    if os.path.lexists(copy):
        mark = _mark_of(copy)
        is_needless = (copy / _BEGUN).is_file() if mark is None else mark["source"] == fingerprint(real)
        if not is_needless and any(copy.iterdir()):
            raise DatasetDamagedError(
                f"{copy} is in the way of repairing {root}: it is a repaired copy of another dataset that stood here, or "
                "no copy at all. Move it elsewhere, or delete it. Nothing was changed."
            )
        shutil.rmtree(copy)
    (copy / SCRATCH).mkdir(parents=True)
    (copy / _BEGUN).touch()
    shutil.copystat(real, copy)
    return copy


def replace(root: Path, copy: Path, source: str) -> Path:
    """Puts a copy that is complete in the place of the dataset. Returns where that is from now on.

    Args:
        root: The dataset; of a link, the folder that it leads to is replaced.
        copy: The copy.
        source: The dataset's `fingerprint` from before it was read.

    Raises:
        OSError: The dataset was changed meanwhile, or a folder cannot be renamed. The dataset is as it was.
    """
    real = root.resolve()
    if fingerprint(real) != source:
        raise OSError(
            f"{root} was changed while it was repaired: wait until nothing writes to it. Nothing was changed."
        )
    names = (real.with_name(f"{real.name}.damaged{f'-{number}' if number else ''}") for number in itertools.count())
    original = next(name for name in names if not os.path.lexists(name))
    flush_all(copy)
    write_atomically(copy / _FINISHED, json.dumps({"source": source, "original": original.name}))
    os.rename(real, original)
    try:
        os.rename(copy, real)
    except OSError:
        os.rename(original, real)
        raise
    _remove_marks(real)
    with contextlib.suppress(
        OSError
    ):  # whatever a power cut leaves of the two renames, `finish_repair` goes on from it
        flush(real.parent)
    return original


def finish_repair(root: Path) -> None:
    """Puts a repaired copy in the place of the dataset, if that is all that was left to do when a repair was killed.

    Raises:
        DatasetDamagedError: There is a repaired copy, but not what it is a copy of.
        OSError: The folders cannot be read or renamed.
    """
    real = root.resolve()
    copy = _copy_of(real)
    if os.path.lexists(real) or not copy.is_dir():
        return
    mark = _mark_of(copy)
    if mark is None:
        return  # it was never finished, and somebody has moved the dataset away
    original = real.with_name(mark["original"])
    if not original.is_dir() or fingerprint(original) != mark["source"]:
        raise DatasetDamagedError(
            f"There is no dataset in {root}, but a repaired copy of one in {copy}, and what it was made from is not in "
            f"{original}. If you want the copy, rename it to {real}; otherwise delete it."
        )
    os.rename(copy, real)
    _remove_marks(real)
    flush(real.parent)


def fingerprint(folder: Path) -> str:
    """Tells one state of a dataset from another: by its files' names, sizes and times.

    Raises:
        OSError: It cannot be read.
    """
    digest = hashlib.sha256()
    for path in entries_below(folder):
        name = path.relative_to(folder)
        if name.parts[0] != SCRATCH.name and not path.is_dir():
            state = path.lstat()
            digest.update(json.dumps([name.as_posix(), state.st_size, state.st_mtime_ns]).encode())
    return digest.hexdigest()


def _copy_of(real: Path) -> Path:
    return real.with_name(f".{real.name}.repairing")


def _mark_of(copy: Path) -> dict[str, str] | None:
    """What a copy is a copy of; None of one that was never finished.

    Raises:
        OSError: It cannot be read.
    """
    try:
        data = (copy / _FINISHED).read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        mark = json.loads(data)
        is_one = isinstance(mark["source"], str) and Path(mark["original"]).name == mark["original"]
    except (ValueError, TypeError, KeyError):
        return None
    return mark if is_one else None


def _remove_marks(folder: Path) -> None:
    """They mean nothing where the dataset is; so it does no harm where one stays."""
    with contextlib.suppress(OSError):
        (folder / _BEGUN).unlink(missing_ok=True)
        (folder / _FINISHED).unlink(missing_ok=True)
        (folder / SCRATCH).rmdir()
