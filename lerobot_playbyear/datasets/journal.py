"""Moving finished files into a dataset so that neither a crash nor a power cut can lose or halve an episode.

Everything of ours lives under LeRobot's scratch folder for frames, which `push_to_hub` leaves out. It may come with a
dataset that a stranger made, so that nothing in it is believed: what a journal names stays inside the dataset, and no
folder is followed that is a link.
"""

import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

SCRATCH = Path("images")
STAGING = SCRATCH / ".staging"
EPISODE = SCRATCH / ".episode"
PICTURES = SCRATCH / ".pictures"
LOCK = SCRATCH / ".lock"
JOURNAL = SCRATCH / ".journal.json"

_PARTS = ("data", "meta", "videos")  # where an episode's files lie
_MOST_BYTES = 2**20  # of a journal: several hundred times what an episode of a hundred cameras needs


class JournalError(ValueError):
    """A journal, or the folder it is in, is none that was written here; nothing was changed."""


def publish(root: Path, names: Iterable[Path]) -> None:
    """Moves files from the staging folder to the same place in the dataset: all of them, or none.

    From the moment the journal stands on the disk the moves count as made: whoever opens the dataset next finishes
    them with `finish_journal`. Everything is on the disk itself before it is referred to.

    Args:
        root: The dataset's folder.
        names: The files, relative to the dataset's folder, in the order in which they are moved.

    Raises:
        JournalError: A file's place is not inside the dataset.
    """
    names = list(names)
    staging = root / STAGING
    _check_moves(root, [name.as_posix() for name in names])
    for name in names:
        flush(staging / name)
    for folder in sorted({staging / parent for name in names for parent in name.parents}):
        flush(folder)
    flush(staging.parent)
    journal = root / JOURNAL
    partial = journal.with_suffix(".partial")
    partial.write_text(json.dumps([name.as_posix() for name in names]))
    flush(partial)
    os.replace(partial, journal)
    flush(journal.parent)
    flush(root)
    finish_journal(root)


def finish_journal(root: Path) -> None:
    """Makes the moves that a journal names, where there is one: the rest of them after a crash.

    Raises:
        JournalError: It is none of ours; nothing was moved.
    """
    journal = root / JOURNAL
    if not os.path.lexists(journal):
        return
    names = _read_names(journal)
    _check_moves(root, names)
    for name in names:
        source, target = root / STAGING / name, root / name
        if source.exists():
            made = make_folders(target.parent)
            os.replace(source, target)
            for folder in {target.parent, *made}:
                flush(folder)
    journal.unlink()
    flush(journal.parent)


def check_scratch(root: Path) -> None:
    """Whether what is written and removed while recording lies in the dataset's folder.

    Raises:
        JournalError: A folder for it is a link.
    """
    for name in (SCRATCH, STAGING, EPISODE, PICTURES):
        if (root / name).is_symlink():
            raise _error(root / name, f"is a link to {os.readlink(root / name)}; wanted a folder", "Remove it")


def make_folders(folder: Path) -> list[Path]:
    """Makes a folder and its parents where they are missing. Returns the folders that got a new entry."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return [path.parent for path in missing]


def flush(path: Path) -> None:
    """Asks the operating system to put a file, or the entries of a folder, on the disk itself."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read_names(journal: Path) -> list[str]:
    """The entries of a journal, whatever they are."""
    check_scratch(journal.parent.parent)
    remedy = f"If nothing is being recorded there, delete it and run `playbyear-repair --root={journal.parent.parent}`"
    details = journal.lstat()
    if not stat.S_ISREG(details.st_mode):
        raise _error(journal, "is no ordinary file", remedy)
    if details.st_size > _MOST_BYTES:
        raise _error(journal, f"has {details.st_size} bytes; wanted at most {_MOST_BYTES}", remedy)
    try:
        names = json.loads(journal.read_bytes())
    except (ValueError, RecursionError) as error:
        raise _error(journal, f"cannot be read: {error}", remedy) from error
    if not isinstance(names, list):
        raise _error(journal, f"holds {type(names).__name__}; wanted a list of files", remedy)
    for name in names:
        if not is_inside(name):
            wanted = f"wanted files below {', '.join(part + '/' for part in _PARTS)}"
            raise _error(journal, f"names {str(name)[:100]!r}; {wanted}", remedy)
    return names


def is_inside(name: object) -> bool:
    """Whether a journal's entry is, letter by letter, a path below one of the folders of a dataset."""
    if not isinstance(name, str) or any(not letter.isprintable() or letter in "\\:" for letter in name):
        return False
    path = PurePosixPath(name)
    return path.as_posix() == name and ".." not in path.parts and len(path.parts) > 1 and path.parts[0] in _PARTS


def _check_moves(root: Path, names: Iterable[str]) -> None:
    """Whether files and the folders they come from and go to are the dataset's own.

    Raises:
        JournalError: One of them is a link, or lies somewhere else.
    """
    check_scratch(root)
    for name in names:
        if not is_inside(name):
            raise _error(root / STAGING / name, "leads out of the dataset", "Choose another folder for the dataset")
        file = root / STAGING / name
        folders = [parent for parent in PurePosixPath(name).parents if parent.name]
        for path in (file, *(base / parent for parent in folders for base in (root / STAGING, root))):
            if path.is_symlink():
                raise _error(path, "is a link; wanted one of the dataset's own", "Put what it leads to in its place")


def _error(path: Path, found: str, remedy: str) -> JournalError:
    return JournalError(f"{path} {found}. Nothing was changed. {remedy}.")
