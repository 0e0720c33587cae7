"""Opening a dataset for reading, whatever the length of its episodes.

LeRobot has a whole row group in memory several times while it makes a file of the data that can be mapped, and writes an
episode as one: two hours with two microphones take more than 4 GB. Such a dataset's file is made here, in parts. LeRobot is
imported when the files have been looked at, so that damage is told at once.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_playbyear.datasets.features import AUDIO_DTYPE, check_audio_features
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME, INFO_PATH
from lerobot_playbyear.datasets.info import check_dataset_files, read_info

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

_LARGE_ROW_GROUP = 2**28  # bytes, uncompressed


def open_dataset(
    repo_id: str, root: str | Path | None = None, episodes: list[int] | None = None, video_backend: str | None = None
) -> "LeRobotDataset | LongDataset":
    """Opens a dataset from its folder, or by its name from LeRobot's cache or the Hub.

    Args:
        repo_id: Its name.
        root: Its folder; None: LeRobot's own place for `repo_id`.
        episodes: Only these; None: all.
        video_backend: LeRobot's video decoder.

    Raises:
        ValueError: If a file of the dataset is truncated, or it is empty, or its sound lies in files beside the frames.
        Exception: Whatever LeRobot raises where there is none, or it cannot be read.
    """
    footers = check_dataset_files(repo_id, root)
    _check_sound(Path(root) if root is not None else HF_LEROBOT_HOME / repo_id)
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

    sizes = (file.row_group(i).total_byte_size for file in footers for i in range(file.num_row_groups))
    if any(size > _LARGE_ROW_GROUP for size in sizes):
        return LongDataset(repo_id, Path(root) if root is not None else HF_LEROBOT_HOME / repo_id, episodes)
    return LeRobotDataset(repo_id, root=root, episodes=episodes, video_backend=video_backend)


def _check_sound(folder: Path) -> None:
    """Refuses sound in files, as LeRobot's pull request 2824 has it, which LeRobot itself cannot open."""
    if not (folder / INFO_PATH).is_file():
        return
    features = read_info(folder)["features"]
    in_files = {key: one for key, one in features.items() if one["dtype"] == AUDIO_DTYPE}
    check_audio_features(in_files, 1)
