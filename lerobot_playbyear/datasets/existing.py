"""What is in a folder already, and whether episodes can be appended to it."""

import os
import shlex
from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.features import differences
from lerobot_playbyear.datasets.files import list_files
from lerobot_playbyear.datasets.journal import JOURNAL, SCRATCH
from lerobot_playbyear.datasets.settling import INFO
from lerobot_playbyear.datasets.survey import DatasetDamagedError, survey


def check_root(root: Path, *, resume: bool) -> None:
    """Whether a dataset can be written to `root`.

    Raises:
        FileExistsError: It holds a dataset and `resume` is off, or it holds other files.
        DatasetWriteError: It is a file.
    """
    if root.exists() and not root.is_dir():
        raise DatasetWriteError(f"Cannot write a dataset to {root}: it is a file.")
    if has_dataset(root) or (root / JOURNAL).is_file():
        if not resume:
            raise FileExistsError(
                f"{root} already holds a dataset. Append to it with resume=true, or choose another root."
            )
    elif root.is_dir() and any(path.name != SCRATCH.name for path in root.iterdir()):
        raise FileExistsError(f"{root} is not empty and holds no dataset. Choose another root.")


def has_dataset(root: Path) -> bool:
    """Whether a folder holds a LeRobotDataset, however damaged.

    Raises:
        OSError: It, or a folder in it, cannot be listed: that says nothing of what it holds.
    """
    try:
        os.listdir(root)
    except FileNotFoundError:
        return False
    return any(list_files(root, name) for name in (INFO.as_posix(), "data/chunk-*/file-*", "meta/episodes/*/*"))


def check_undamaged(root: Path) -> None:
    """Whether a dataset can be continued as it is. Nothing is changed; a quick look, without pictures and sound.

    Raises:
        DatasetDamagedError: It is damaged; with what is wrong, and the command that repairs it.
        DatasetWriteError: It cannot be read.
    """
    try:
        found = survey(root, thorough=False)
    except OSError as error:
        raise DatasetWriteError(f"Cannot read {root}: {error}. Nothing was changed.") from error
    if not found.is_sound:
        command = f"playbyear-repair --root={shlex.quote(str(root))}"
        raise DatasetDamagedError(
            f"{found}\nNothing was changed, and nothing is appended to a damaged dataset. `{command} --dry_run=true` looks "
            f"again, more closely, and `{command}` writes a copy with the episodes that are whole."
        )


def check_compatible(
    meta: LeRobotDatasetMetadata, fps: int, features: dict[str, dict], robot_type: str | None = None
) -> None:
    """Whether frames of `features` at `fps`, of a robot of this type, can be appended to an existing dataset.

    Names of numbers, such as joints, and types of robots are compared where both sides have them.

    Raises:
        ValueError: With every difference in the message.
    """
    found = [f"fps is {meta.fps} there and {fps} here"] if meta.fps != fps else []
    found += differences(meta.features, features)
    if meta.robot_type and robot_type and meta.robot_type != robot_type:
        found.append(f"the robot is {meta.robot_type} there and {robot_type} here")
    if found:
        raise ValueError(
            f"The dataset in {meta.root} does not fit what is to be appended: {'; '.join(found)}. "
            "Record with the same settings, or choose another root."
        )
