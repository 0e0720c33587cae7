"""Moving finished files into a dataset so that neither a crash nor a power cut can lose or halve an episode.

Everything of ours lives under LeRobot's scratch folder for frames, which `push_to_hub` leaves out.
"""

import json
import os
from collections.abc import Iterable
from pathlib import Path

SCRATCH = Path("images")
STAGING = SCRATCH / ".staging"
LOCK = SCRATCH / ".lock"
JOURNAL = SCRATCH / ".journal.json"


def publish(root: Path, names: Iterable[Path]) -> None:
    """Moves files from the staging folder to the same place in the dataset: all of them, or none.

    From the moment the journal stands on the disk the moves count as made: whoever opens the dataset next finishes
    them with `finish_journal`. Everything is on the disk itself before it is referred to.

    Args:
        root: The dataset's folder.
        names: The files, relative to the dataset's folder, in the order in which they are moved.
    """
    names = list(names)
    staging = root / STAGING
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
    """Makes the moves that a journal names, where there is one: the rest of them after a crash."""
    journal = root / JOURNAL
    if not journal.exists():
        return
    try:
        names = [str(name) for name in json.loads(journal.read_text())]
    except (ValueError, TypeError):
        names = []  # damaged later: what was moved already, the check of the dataset finds
    for name in names:
        source, target = root / STAGING / name, root / name
        if source.exists():
            made = make_folders(target.parent)
            os.replace(source, target)
            for folder in {target.parent, *made}:
                flush(folder)
    journal.unlink()
    flush(journal.parent)


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
