"""What a repaired copy takes over as it is: everything but the frames and the tables that may be written anew."""

import shutil
from collections.abc import Collection
from pathlib import Path

from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH

from lerobot_playbyear.datasets.files import fits, list_files, take_over
from lerobot_playbyear.datasets.journal import JOURNAL, LOCK, SCRATCH, STAGING
from lerobot_playbyear.datasets.repair.replacing import MARKS

_SCRATCH_NAMES = {LOCK.name, JOURNAL.name, STAGING.name, JOURNAL.with_suffix(".partial").name, *MARKS}
_REMADE = (INFO_PATH, STATS_PATH, DEFAULT_TASKS_PATH, "data/*/*.parquet", f"{EPISODES_DIR}/*/*.parquet")
_FOLDERS = ("data", "data/*", "meta", EPISODES_DIR, f"{EPISODES_DIR}/*", SCRATCH.name)  # that are written into


def take_over_rest(root: Path, target: Path, features: Collection[str]) -> list[str]:
    """Everything but the frames and the tables of `meta/`: videos, a card, notes, files of other tools.

    Args:
        root: The dataset's folder.
        target: The copy's, in which nothing is but its mark.
        features: The names of the dataset's features.

    Returns:
        What stays behind, a line each.

    Raises:
        OSError: Something cannot be read now, or written.
    """
    notes: list[str] = []

    def stays_behind(name: Path) -> bool:
        path = root / name
        if path.is_symlink() and path.is_dir() and fits(name, *_FOLDERS):
            # Through a copy of the link the files behind it would be written over. It may have led anywhere: what is not
            # the dataset's stays there.
            notes.append(
                f"{name.as_posix()} was a link to {path.readlink()}; it is now a folder, with the frames or tables of the "
                "dataset alone"
            )
            return True
        if name.parent != SCRATCH:
            return fits(name, *_REMADE)
        if name.name in features and list_files(path, "*/*"):
            notes.append(f"{name.as_posix()}: pictures of an episode that was not saved stay behind")
        # What was only needed while an episode was written: LeRobot would take leftovers of it for the next one's.
        return name.name in features or name.name in _SCRATCH_NAMES

    def leave(where: str, names: list[str]) -> list[str]:
        return [name for name in sorted(names) if stays_behind(Path(where).relative_to(root) / name)]

    def copy(source: str, new: str) -> None:
        """Nobody changes a film in place; of a user's own files that is not known."""
        is_film = Path(source).relative_to(root).parts[0] == "videos"
        (take_over if is_film else shutil.copy2)(source, new)

    shutil.copytree(root, target, symlinks=True, dirs_exist_ok=True, ignore=leave, copy_function=copy)
    return sorted(notes)
