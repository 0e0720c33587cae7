"""What a repaired copy takes over as it is: everything but the frames and the tables that may be written anew."""

import errno
import glob
import os
import shutil
from collections.abc import Callable, Collection
from pathlib import Path

from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from lerobot_playbyear.datasets.files import fits, list_files
from lerobot_playbyear.datasets.journal import JOURNAL, LOCK, SCRATCH, STAGING
from lerobot_playbyear.datasets.repair.replacing import MARKS

_SCRATCH_NAMES = {LOCK.name, JOURNAL.name, STAGING.name, JOURNAL.with_suffix(".partial").name, *MARKS}
_REMADE = (INFO_PATH, STATS_PATH, DEFAULT_TASKS_PATH, "data/*/*.parquet", f"{EPISODES_DIR}/*/*.parquet")


def take_over(source: str | Path, target: str | Path) -> None:
    """A second name for a file that nobody changes in place, or a copy where there can be none."""
    source, target = Path(source), Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
        if source.stat().st_size != target.stat().st_size:
            raise OSError(errno.EIO, "it could not be copied as a whole", str(source)) from None


def take_over_rest(root: Path, target: Path, features: Collection[str]) -> list[str]:
    """Everything but the frames and the tables of `meta/`: videos, a card, notes, files of other tools.

    Args:
        root: The dataset's folder.
        target: The copy's, which is empty.
        features: The names of the dataset's features.

    Returns:
        What stays behind, a line each.

    Raises:
        OSError: Something cannot be read now, or written.
    """
    notes: list[str] = []
    for path in sorted(root.iterdir()):
        new = target / path.name
        if path.name in ("data", "meta", SCRATCH.name) and path.is_dir():
            if path.is_symlink():
                notes.append(_unlinked(path, path.name))
                continue
            leave = _pictures_in_progress(path, features, notes) if path.name == SCRATCH.name else _ours_in(path, notes)
            shutil.copytree(path, new, symlinks=True, dirs_exist_ok=True, ignore=leave)
        elif path.is_symlink():
            new.symlink_to(path.readlink())
        elif path.is_dir():
            # Nobody changes a film in place; of a user's own files that is not known.
            copy = take_over if path.name == "videos" else shutil.copy2
            shutil.copytree(path, new, symlinks=True, copy_function=copy)
        else:
            shutil.copy2(path, new)
    return notes


def _ours_in(folder: Path, notes: list[str]) -> Callable[[str, list[str]], set[str]]:
    """What is written in another way: the frames in `data`, and the tables in `meta`.

    So are folders for these that are links: through a copy of the link, the files behind it would be written over.
    """

    def leave(where: str, names: list[str]) -> set[str]:
        place = Path(folder.name) / Path(where).relative_to(folder)
        left = set()
        for path in (place / name for name in names):
            own = folder.parent / path
            if own.is_symlink() and own.is_dir() and fits(path, "data/*", EPISODES_DIR, f"{EPISODES_DIR}/*"):
                notes.append(_unlinked(own, path.as_posix()))
                left.add(path.name)
            elif fits(path, *_REMADE):
                left.add(path.name)
        return left

    return leave


def _unlinked(folder: Path, name: str) -> str:
    """Says that a folder takes a link's place. It may have led anywhere: what is not the dataset's stays there."""
    return (
        f"{name} was a link to {folder.readlink()}; it is now a folder, with the frames or tables of the dataset alone"
    )


def _pictures_in_progress(
    folder: Path, features: Collection[str], notes: list[str]
) -> Callable[[str, list[str]], set[str]]:
    """What was only needed while an episode was written: LeRobot would take leftovers of it for the next one's."""

    def leave(where: str, names: list[str]) -> set[str]:
        if Path(where) != folder:
            return set()
        cameras = {name for name in names if name in features}
        notes.extend(
            f"images/{name}: pictures of an episode that was not saved stay behind"
            for name in sorted(cameras)
            if list_files(folder, f"{glob.escape(name)}/*/*")
        )
        return cameras | {name for name in names if name in _SCRATCH_NAMES}

    return leave
