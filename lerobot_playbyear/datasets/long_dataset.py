"""A dataset with long episodes, opened for reading whole columns."""

import tempfile
from pathlib import Path

import datasets
import pyarrow as pa
import pyarrow.compute as pc
from datasets.arrow_writer import ArrowWriter
from datasets.table import table_cast
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features

from lerobot_playbyear.datasets.parquet import open_checked, row_group_parts


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
                with open_checked(name) as file:
                    for group in range(file.num_row_groups):
                        for table in row_group_parts(file, group):
                            is_wanted = (
                                None if episodes is None else pc.is_in(table["episode_index"], pa.array(episodes))
                            )
                            wanted = table if is_wanted is None else table.filter(is_wanted)
                            if len(wanted):
                                writer.write_table(table_cast(wanted, features.arrow_schema))
            writer.finalize()
        return datasets.Dataset.from_file(str(path))


def scratch_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for files of gigabytes, where LeRobot has its own: what `tempfile` chooses by itself may be memory."""
    cache = Path(datasets.config.HF_DATASETS_CACHE)
    cache.mkdir(parents=True, exist_ok=True)
    return tempfile.TemporaryDirectory(dir=cache, prefix="playbyear-")
