"""Files and folders: what is missing told from what cannot be read, what is written there whole or not at all, one lock.

What a damaged dataset lacks is dropped. So a file counts as missing only where its folder can be listed and does not
name it; a folder that cannot be listed is an error, never an empty one.

Nothing is written or deleted through a link. The names are LeRobot's, spelled here as well because its own modules
with them take seconds to import; a test compares them.
"""

import contextlib
import fnmatch
import glob
import json
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

from filelock import FileLock, Timeout
from huggingface_hub.constants import HF_HOME

from lerobot_playbyear.datasets.errors import InputError

HF_LEROBOT_HOME = Path(os.getenv("HF_LEROBOT_HOME", Path(HF_HOME) / "lerobot")).expanduser()
"""LeRobot's own cache, where datasets without a root are."""

INFO_PATH = "meta/info.json"
EPISODES_DIR = "meta/episodes"
DEFAULT_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DEFAULT_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

PARTIAL = ".partial"
"""What the name of a file or a folder ends in while it is written."""


class FolderLockedError(InputError):
    """Another process works in the folder."""


def list_files(root: Path, pattern: str) -> list[Path]:
    """What matches a pattern, in order, like `sorted(root.glob(pattern))`.

    Args:
        root: A folder.
        pattern: Parts with wildcards, one for each level below it.

    Raises:
        OSError: A folder on the way cannot be listed.
    """
    found = [root]
    for part in Path(pattern).parts:
        found = [path / name for path in found for name in _names(path) if fnmatch.fnmatchcase(name, part)]
    return sorted(found)


def entries_below(folder: Path) -> Iterator[Path]:
    """Everything in a folder, without going through links."""
    for entry in sorted(folder.iterdir()):
        yield entry
        if entry.is_dir() and not entry.is_symlink():
            yield from entries_below(entry)


def fits(name: PurePath, *patterns: str) -> bool:
    """Whether a name, as a whole, matches one of some patterns, part by part."""
    return any(len(name.parts) == len(PurePath(pattern).parts) and name.match(pattern) for pattern in patterns)


def is_listed(root: Path, name: str | Path) -> bool:
    """Whether a folder has a file, which is not yet to say that it can be read.

    Raises:
        OSError: A folder on the way cannot be listed.
    """
    return bool(list_files(root, glob.escape(Path(name).as_posix())))


def parse_json(data: str | bytes) -> Any:
    """What JSON says.

    Raises:
        ValueError: It is none, or a stranger's, in which one thing lies in another without end.
    """
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Puts a file's name into errors that do not say it, as those of reading from an open file.

    Raises:
        OSError: With the name.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None or not error.errno:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def flush(path: Path) -> None:
    """Asks the operating system to put a file, or the entries of a folder, on the disk itself."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def flush_all(folder: Path) -> None:
    """As `flush`, of a folder and all that is in it but links."""
    for path in entries_below(folder):
        if not path.is_symlink():
            flush(path)
    flush(folder)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes a file that is there as a whole, on the disk itself, or as it was before."""
    partial = path.with_name(path.name + PARTIAL)
    partial.unlink(missing_ok=True)
    with partial.open("xb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
    flush(partial)
    os.replace(partial, path)
    flush(path.parent)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """A file that is there as a whole or not at all, where others may write one of its name at the same time.

    Args:
        path: Its place; the folder is made, and what was there is replaced. A link there is replaced, not followed.

    Yields:
        Of an empty file beside it, with the same ending, to write into. Where that raises, it is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{PARTIAL}{path.suffix}")
    partial.open("x").close()
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def append_line(path: Path, line: str) -> None:
    """Writes a line at the end of a file, which is made where it is missing.

    Raises:
        OSError: It cannot be written, or is a link.
    """
    new = os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    with os.fdopen(os.open(path, new, 0o666), "a+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        begin = b"" if file.read(1) in (b"", b"\n") else b"\n"  # half a line, of a power cut, stays alone
        file.write(begin + line.encode() + b"\n")


def replace_link(place: Path, name: str) -> None:
    """Makes a link to a folder beside it, in place of the one that is there or, in a copy, of the folder that it named."""
    link = place.with_name(place.name + PARTIAL)
    link.unlink(missing_ok=True)
    link.symlink_to(name)
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place)
    os.replace(link, place)


def is_special(path: Path) -> bool:
    """Whether a pipe or a device is there, or a link leads to one: opening it may wait for ever."""
    return path.exists() and not path.is_file() and not path.is_dir()


def check_no_links(folder: Path, *names: str) -> None:
    """Whether what is written below a folder stays in it.

    Args:
        folder: Of a run; it may be a stranger's.
        names: Of folders in it that are written into, and of files that are written in place.

    Raises:
        InputError: One of them is a link, a pipe or a device.
    """
    for path in (folder / name for name in names):
        if path.is_symlink():
            raise InputError(
                f"'{path}' is a link to '{os.readlink(path)}', and nothing is written or removed there. Put what it leads to "
                "in its place, or choose an --output_dir where there is room."
            )
        if is_special(path):
            raise InputError(f"'{path}' is a pipe or a device, no file. Remove it, or choose another --output_dir.")


@contextlib.contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """A folder that is there as a whole, on the disk itself, or not at all: it is written beside its place, and renamed.

    Args:
        target: Its place, where nothing is. What an earlier process left unfinished beside it is removed.

    Yields:
        The empty folder to write into. Where that raises, it is removed.

    Raises:
        FolderLockedError: Another process writes one of this name.
        OSError: It cannot be written, or something is at its place.
    """
    partial = target.absolute().with_name(f".{target.name}{PARTIAL}")
    lock = partial.with_suffix(".lock")
    with FolderLock(lock, f"Another process is writing {target}: wait until it has ended, or choose another place."):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        try:
            yield partial
            flush_all(partial)
            os.rename(partial, target)
            flush(partial.parent)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            with contextlib.suppress(OSError):  # Windows removes no open file
                lock.unlink()  # whoever gets a lock whose file is gone makes another


class FolderLock(contextlib.ExitStack):
    """At most one process works in a folder: held until `close` or the end of the process, however it ends.

    The lock's file stays where it is: two processes that found different files under its name could both hold one.

    Args:
        path: The lock's file; its folder is made where it is missing.
        in_use: What is said where another process holds it.

    Raises:
        FolderLockedError: Another process holds it.
        OSError: It cannot be written, or is a link.
    """

    def __init__(self, path: Path, in_use: str) -> None:
        super().__init__()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self.enter_context(FileLock(path, timeout=0, thread_local=False))
        except Timeout as error:
            raise FolderLockedError(in_use) from error


_trial = ".playbyear-"  # begin of the name of a folder that is made for a moment


def is_trial(name: str) -> bool:
    """Whether a folder of this name is one that `check_can_be_made` makes for a moment."""
    return name.startswith(_trial)


def check_can_be_made(folder: Path, option: str) -> None:
    """Whether a folder can be made, or written into where it is there already. It tries, and leaves nothing behind.

    Args:
        folder: The folder; those above it need not be there either.
        option: What it was asked for with, such as "--output_dir=outputs/train", for the message.

    Raises:
        InputError: Nothing can be written there.
    """
    folder = folder.absolute()
    there = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
    try:
        with tempfile.TemporaryDirectory(prefix=_trial, dir=there):
            pass
    except OSError as error:
        raise InputError(
            f"{option} cannot be written: {error.strerror or error} in {there}; wanted a folder that can be made. Give "
            "another, or allow writing there."
        ) from error


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except NotADirectoryError:
        return []
