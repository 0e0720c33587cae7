"""The intervention dataset, on disk and in memory at once."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import SUCCESS

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.reader import DatasetPlace, DatasetReader, check_dataset_files
from lerobot_playbyear.episodes.frames import INTERVENTION, SEED, save_episode
from lerobot_playbyear.episodes.play import Episode
from lerobot_playbyear.training.store import EpisodeStore


class Corrections:
    """Whole attempts with corrections; each is on disk for good before it is learned from.

    Args:
        source: Where they are kept.

    Attributes:
        store: The attempts in memory; None while there are none.
    """

    def __init__(self, source: DatasetPlace) -> None:
        self._source = source
        self._writer: DurableWriter | None = None
        self.store: EpisodeStore | None = None

    @cached_property
    def meta(self) -> LeRobotDatasetMetadata:
        """Of the dataset, on disk or on the Hub.

        Raises:
            InputError: It does not say which frames an expert chose.
            ValueError: It is empty or damaged.
        """
        check_dataset_files(self._source.repo_id, self._source.root)
        meta = LeRobotDatasetMetadata(self._source.repo_id, root=self._source.root)
        feature = meta.features.get(INTERVENTION)
        if feature is None or feature["dtype"] != "bool" or tuple(feature["shape"]) != (1,):
            seen = "no such feature" if feature is None else f"{feature['dtype']} {tuple(feature['shape'])}"
            raise InputError(
                f"The dataset '{meta.repo_id}' does not say which frames an expert chose: wanted '{INTERVENTION}', bool (1,), "
                f"and there is {seen}. Give one that playbyear-dagger or lerobot-rollout --strategy.type=dagger wrote."
            )
        return meta

    def open_for_writing(self, fps: int, features: dict[str, dict[str, Any]], robot_type: str) -> None:
        """Create the dataset, or take it up where it ended.

        Args:
            fps: Frames per second.
            features: Of what is appended, from `dataset_features`.
            robot_type: Noted in a new dataset's metadata.

        Raises:
            ValueError: It holds other features.
            DatasetWriteError: It cannot be written, or another process writes to it.
        """
        folder = self._source.folder
        self._writer = DurableWriter(self._source.repo_id, folder, fps, features, resume=True, robot_type=robot_type)
        self._opened_as = (fps, features, robot_type)

    def read(self, keys: Sequence[str], device: torch.device, image_size: int | None = None) -> None:
        """Take what the dataset holds into memory; nothing while it is empty.

        Args:
            keys: The features that the policy's windows are cut from.
            device: Where the store is kept.
            image_size: The size that the demonstrations' pictures were shrunk to, if they were [pixels].

        Raises:
            ValueError: It is damaged.
        """
        self._read_as: tuple[Any, ...] = (keys, device, image_size)
        if not self.n_episodes:
            return
        reader = DatasetReader(self._source.repo_id, self._source.root)
        further = [key for key in (SEED, SUCCESS) if key in reader.features]
        wanted = [*keys, INTERVENTION, *further]
        self.store = EpisodeStore.from_dataset(reader, wanted, device, image_size=image_size)

    def another(self, source: DatasetPlace) -> "Corrections":
        """A dataset for attempts that are no corrections, opened and read as this one is."""
        others = Corrections(source)
        others.open_for_writing(*self._opened_as)
        others.read(*self._read_as)
        return others

    @property
    def n_episodes(self) -> int:
        """Attempts in the dataset."""
        return self._writer.num_episodes if self._writer is not None else self.meta.total_episodes

    def append(self, episode: Episode) -> None:
        """Write an attempt to disk, then take it into memory.

        Raises:
            DatasetWriteError: It could not be written; the dataset is as it was before.
        """
        assert self._writer is not None
        frames = save_episode(episode, self._writer)
        if self.store is None:
            self.read(*self._read_as)
        else:
            self.store.append_episode(frames)

    def last(self) -> tuple[dict[str, Any], np.ndarray]:
        """Figures of the last attempt, and (T,) bool, which of its frames hold an action of the expert's."""
        assert self.store is not None
        start, end = self.store.starts[-1], self.store.ends[-1]
        by_expert = frames_by_expert(self.store)[start:end].numpy()
        figures = {
            "seed": int(self.store.column(SEED)[end - 1]),
            "n_frames": end - start,
            "success": bool(self.store.column(SUCCESS)[-1].any()) if SUCCESS in self.store.keys else True,
        }
        return figures, by_expert

    def close(self) -> None:
        """Nothing is appended any more."""
        if self._writer is not None:
            self._writer.close()
