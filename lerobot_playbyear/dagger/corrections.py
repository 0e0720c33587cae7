"""The intervention dataset, on disk and in memory at once."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.utils.constants import SUCCESS

from lerobot_playbyear.dagger.batches import frames_by_expert
from lerobot_playbyear.dagger.checks import check_corrections
from lerobot_playbyear.dagger.config import DatasetSource
from lerobot_playbyear.datasets import EpisodeStore, check_dataset_files
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.frames import INTERVENTION, SEED
from lerobot_playbyear.episodes.saving import save_episode


class Corrections:
    """Whole attempts with corrections; each is on disk for good before it is learned from.

    Args:
        source: Where they are kept.

    Attributes:
        store: The attempts in memory; None while there are none.
    """

    def __init__(self, source: DatasetSource) -> None:
        self._source = source
        self._writer: DurableWriter | None = None
        self._keys: list[str] | None = None
        self._device: torch.device | None = None
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
        check_corrections(meta)
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

    def read(self, keys: Sequence[str] | None, device: torch.device, image_size: int | None = None) -> None:
        """Take what the dataset holds into memory; nothing while it is empty.

        Args:
            keys: The features that the policy's windows are cut from; None for all.
            device: Where the store is kept.
            image_size: The size that the demonstrations' pictures were shrunk to, if they were [pixels].

        Raises:
            ValueError: It is damaged.
        """
        self._keys = None if keys is None else [*keys, INTERVENTION]
        self._device, self._image_size = device, image_size
        if self.n_episodes:
            self._read()

    def _read(self) -> None:
        backend = self._source.video_backend
        dataset = LeRobotDataset(self._source.repo_id, root=self._source.root, video_backend=backend)
        further = [key for key in (SEED, SUCCESS) if key in dataset.meta.features]
        keys = self._keys and self._keys + further
        self.store = EpisodeStore.from_dataset(dataset, keys, self._device, backend, image_size=self._image_size)

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
            self._read()
        else:
            self.store.append_episode(frames)

    def last(self) -> dict[str, Any]:
        """Figures of the last attempt: its seed, its length and how much of it the expert chose."""
        assert self.store is not None
        start, end = self.store.starts[-1], self.store.ends[-1]
        share = self.store.column(INTERVENTION)[start:end].float().mean()
        seed = self.store.column(SEED)[end - 1]
        return {"seed": int(seed), "n_frames": end - start, "intervention_share": round(float(share), 4)}

    def last_by_expert(self) -> np.ndarray:
        """(T,) bool, which frames of the last attempt hold an action of the expert's."""
        assert self.store is not None
        return frames_by_expert(self.store)[self.store.starts[-1] :].cpu().numpy()

    def last_success(self) -> bool:
        """Whether the last attempt solved its task."""
        assert self.store is not None
        return bool(self.store.column(SUCCESS)[-1].any()) if SUCCESS in self.store.keys else True

    def close(self) -> None:
        """Nothing is appended any more."""
        if self._writer is not None:
            self._writer.close()
