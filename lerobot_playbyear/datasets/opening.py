"""Opening a dataset for reading, whatever the length of its episodes.

LeRobot has a whole row group in memory several times while it makes a file of the data that can be mapped, and writes an
episode as one: two hours with two microphones take more than 4 GB. Such a dataset's file is made here, in parts.
"""

import tempfile
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.parquet as pq
from datasets.arrow_writer import ArrowWriter
from datasets.table import table_cast
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_playbyear.datasets.columns import check_dataset_files, column_to_numpy
from lerobot_playbyear.datasets.parquet_files import open_parquet, row_group_parts

_LARGE_ROW_GROUP = 2**28  # bytes, uncompressed


class LongDataset:
    """A local dataset with long episodes: of LeRobotDataset what reading whole columns needs.

    Args:
        repo_id: Its name.
        root: Its folder.
        episodes: Only these; None: all.

    Attributes:
        repo_id, root, meta, fps, num_episodes, features, tolerance_s, hf_dataset: As LeRobotDataset's.
    """

    def __init__(self, repo_id: str, root: Path, episodes: list[int] | None = None) -> None:
        self.repo_id, self.root = repo_id, root
        self.meta = LeRobotDatasetMetadata(repo_id, root)
        self.fps, self.features = self.meta.fps, self.meta.features
        self.num_episodes = self.meta.total_episodes if episodes is None else len(episodes)
        self.tolerance_s = 1e-4  # LeRobot's own
        self._folder = scratch_folder()  # until this object is gone
        self.hf_dataset = self._map(Path(self._folder.name) / "data.arrow", episodes)

    def __len__(self) -> int:
        """The frames of the episodes."""
        return len(self.hf_dataset)

    def _map(self, path: Path, episodes: list[int] | None) -> datasets.Dataset:
        features = get_hf_features_from_features(self.meta.features)
        with ArrowWriter(features=features, path=str(path)) as writer:
            for name in sorted((self.root / "data").glob("*/*.parquet")):
                with open_parquet(name) as file:
                    for group in range(file.num_row_groups):
                        for table in row_group_parts(file, group):
                            wanted = table if episodes is None else _of(table, episodes)
                            if len(wanted):
                                writer.write_table(table_cast(wanted, features.arrow_schema))
            writer.finalize()
        return datasets.Dataset.from_file(str(path))


def scratch_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for files of gigabytes, where LeRobot has its own: what `tempfile` chooses by itself may be memory."""
    cache = Path(datasets.config.HF_DATASETS_CACHE)
    cache.mkdir(parents=True, exist_ok=True)
    return tempfile.TemporaryDirectory(dir=cache, prefix="playbyear-")


def open_dataset(
    repo_id: str, root: str | Path | None = None, episodes: list[int] | None = None, video_backend: str | None = None
) -> LeRobotDataset | LongDataset:
    """Opens a dataset from its folder, or by its name from LeRobot's cache or the Hub.

    Args:
        repo_id: Its name.
        root: Its folder; None: LeRobot's own place for `repo_id`.
        episodes: Only these; None: all.
        video_backend: LeRobot's video decoder.

    Raises:
        ValueError: If a file of the dataset is truncated, or it is empty.
        Exception: Whatever LeRobot raises where there is none, or it cannot be read.
    """
    check_dataset_files(repo_id, root)
    folder = Path(root) if root is not None else HF_LEROBOT_HOME / repo_id
    if (folder / "meta" / "info.json").is_file() and any(map(_is_long, folder.glob("data/*/*.parquet"))):
        return LongDataset(repo_id, folder, episodes)
    return LeRobotDataset(repo_id, root=root, episodes=episodes, video_backend=video_backend)


def _is_long(path: Path) -> bool:
    file = pq.read_metadata(path)
    return any(file.row_group(i).total_byte_size > _LARGE_ROW_GROUP for i in range(file.num_row_groups))


def _of(table: pa.Table, episodes: list[int]) -> pa.Table:
    found = column_to_numpy(table.column("episode_index"))
    return table.filter(pa.array([number in episodes for number in found.tolist()]))
