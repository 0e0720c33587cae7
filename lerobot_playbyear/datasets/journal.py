"""Moving finished files into a dataset so that neither a crash nor a power cut can lose or halve an episode.

Everything of ours lives under LeRobot's scratch folder for frames, which `push_to_hub` leaves out. It may come with a
dataset that a stranger made, so that nothing in it is believed: a journal says no more than that it is there, what is
moved stays inside the dataset, and no folder is followed that is a link.
"""

import contextlib
import os
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from lerobot_playbyear.datasets import files
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import INFO_PATH, FolderLock, flush, is_listed
from lerobot_playbyear.datasets.remedies import repair_command

SCRATCH = Path("images")
STAGING = SCRATCH / ".staging"
LOCK = SCRATCH / ".lock"
JOURNAL = SCRATCH / ".journal.json"

_PARTS = ("data", "meta", "videos")  # where an episode's files lie


class JournalError(InputError):
    """A journal, or the folder it is in, is none that was written here; nothing was changed."""


def publish(root: Path) -> None:
    """Moves the files of the staging folder to the same place in the dataset: all of them, or none.

    From the moment the journal stands on the disk the moves count as made: whoever opens the dataset next finishes
    them with `finish_journal`. Everything is on the disk itself before it is referred to.

    Args:
        root: The dataset's folder.

    Raises:
        JournalError: A file's place is not inside the dataset.
    """
    _staged_files(root)  # raises where one of them leads elsewhere
    files.flush_all(root / STAGING)
    flush(root / SCRATCH)
    files.write_atomically(root / JOURNAL, "")
    flush(root)
    finish_journal(root)


def finish_journal(root: Path) -> None:
    """Makes the moves that a journal stands for, where there is one: the rest of them after a crash.

    Raises:
        JournalError: It, or what is to be moved, is none of ours; nothing was moved.
        OSError: It cannot be looked at now, which is not to say that there is none; or something cannot be moved.
    """
    journal = root / JOURNAL
    if not is_listed(root, JOURNAL):
        return
    names = _staged_files(root)
    if not stat.S_ISREG(journal.lstat().st_mode):
        remedy = f"If nothing is being recorded there, delete it and run `{repair_command(root)}`"
        raise _error(journal, "is not an ordinary file", remedy)
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(root / STAGING / name, root / name)
        for folder in name.parents:  # any of them may be new
            flush(root / folder)
    journal.unlink()
    flush(journal.parent)
    shutil.rmtree(root / STAGING, ignore_errors=True)  # only folders are left in it


def remove_staged(root: Path) -> bool:
    """Removes what was staged of an episode and not published. Returns whether there was anything."""
    staging = root / STAGING
    was_there = any(path.is_file() for path in staging.rglob("*"))
    if staging.is_dir():
        shutil.rmtree(staging)
    return was_there


def lock_dataset(root: Path) -> FolderLock:
    """Makes this process the only one that writes to a dataset, or uploads it; its folder is made where it is missing.

    Raises:
        FolderLockedError: Another process does.
        JournalError: The folder that the lock lies in is a link.
        OSError: It cannot be written.
    """
    check_scratch(root)
    new = [folder for folder in (root, *root.absolute().parents) if not folder.exists()]
    lock = FolderLock(root / LOCK, f"Another process is writing to {root}, or uploading it: wait until it has ended.")
    for folder in new:  # else a power cut could take them, with all episodes
        flush(folder.parent)
    return lock


@contextlib.contextmanager
def locked(root: Path) -> Iterator[bool]:
    """Keeps others from writing to a dataset that is read; where no lock can be made, nobody can write to it.

    Yields:
        Whether there is a lock.

    Raises:
        FolderLockedError, JournalError: As `lock_dataset`.
    """
    try:
        lock = lock_dataset(root)
    except OSError:
        yield False
        return
    with lock:
        yield True


def check_scratch(root: Path) -> None:
    """Whether what is written and removed while recording lies in the dataset's folder.

    Raises:
        JournalError: A folder for it is a link.
    """
    for name in (SCRATCH, STAGING):
        if (root / name).is_symlink():
            raise _error(root / name, f"is a link to {os.readlink(root / name)}; wanted a folder", "Remove it")


def _staged_files(root: Path) -> list[Path]:
    """The files to move, relative to the dataset's folder, so that nothing comes before what it refers to.

    That is: frames and films, the tables of `meta`, those of its episodes, and last `meta/info.json`.

    Raises:
        JournalError: One of them, or a folder that they come from or go to, is a link.
    """
    check_scratch(root)
    staging = root / STAGING
    names: list[Path] = []
    for entry in files.entries_below(staging) if is_listed(root, STAGING) else ():
        name = entry.relative_to(staging)
        for path in (entry, root / name):
            if path.is_symlink() and (path == entry or entry.is_dir()):
                raise _error(path, "is a link; wanted one of the dataset's own", "Put what it leads to in its place")
        if entry.is_file() and name.parts[0] in _PARTS:
            names.append(name)
    return sorted(names, key=lambda name: (name.parts[0] == "meta", name == Path(INFO_PATH), len(name.parts) > 2))


def _error(path: Path, found: str, remedy: str) -> JournalError:
    return JournalError(f"{path} {found}. Nothing was changed. {remedy}.")
