"""A dataset beside the real one, into which one episode is written: by LeRobot all but its sound."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import av
import datasets
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import validate_frame
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_IMAGE_PATH, INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES
from lerobot.utils.utils import SuppressProgressBars
from torch import Tensor

from lerobot_playbyear.datasets.audio_feature import audio_keys

_PNG_END = b"IEND\xaeB`\x82"


class IncompleteEpisodeError(RuntimeError):
    """A camera's frames did not all reach the disk."""


class Staging:
    """An episode in progress.

    LeRobot writes it to a dataset of its own that continues the real one. The sound does not take that way, on which
    every sample would become a Python number and every sample index get statistics: it is kept here, and
    `settle_episode` adds it.

    Args:
        repo_id: The dataset's name.
        root: The real dataset's folder. Where it holds none, the staging dataset is a new one.
        folder: The staging dataset's folder, emptied.
        create_options: For `LeRobotDataset.create`, besides `write_options`.
        write_options: For `LeRobotDataset.create` and `LeRobotDataset.resume`.

    Attributes:
        folder: The staging dataset's folder.
        dataset: The staging dataset.
        features: All features, as `meta/info.json` has them.
        before: Files that were put there for LeRobot to continue from, relative to `folder`.
    """

    def __init__(
        self, repo_id: str, root: Path, folder: Path, create_options: dict[str, Any], write_options: dict[str, Any]
    ) -> None:
        self.folder = folder
        self.before: set[Path] = set()
        self._is_streaming = bool(write_options.get("streaming_encoding"))
        shutil.rmtree(folder, ignore_errors=True)
        if (root / INFO_PATH).is_file():
            self.features = self._copy_metadata(root)
            with _datasets_cache_in(folder / ".cache"), SuppressProgressBars():
                self.dataset = LeRobotDataset.resume(repo_id, root=folder, **write_options)
        else:
            self.features = {**deepcopy(create_options["features"]), **DEFAULT_FEATURES}
            own = {**create_options, "features": _without_sound(create_options["features"])}
            self.dataset = LeRobotDataset.create(repo_id, root=folder, **own, **write_options)
        self._blocks: dict[str, list[np.ndarray]] = {key: [] for key in audio_keys(self.features)}

    @property
    def length(self) -> int:
        """The frames of the episode so far."""
        writer = self.dataset.writer
        return 0 if writer is None or writer.episode_buffer is None else writer.episode_buffer["size"]

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame.

        Raises:
            ValueError: It does not fit the features.
        """
        values = {key: value.numpy() if isinstance(value, Tensor) else value for key, value in frame.items()}
        validate_frame(values, self.features)
        self.dataset.add_frame({key: value for key, value in values.items() if key not in self._blocks})
        for key, blocks in self._blocks.items():
            blocks.append(values[key].copy())  # a sound card may use its buffer again

    def save(self) -> dict[str, np.ndarray]:
        """Has LeRobot write the episode and close its files. Returns the sound of each microphone, (n_frames, S).

        Raises:
            IncompleteEpisodeError: Pictures are missing.
        """
        length = self.length
        check_pictures(self.dataset, streaming=self._is_streaming)
        with SuppressProgressBars():
            self.dataset.save_episode(parallel_encoding=False)
        self.dataset.finalize()
        check_videos(self.dataset, length)
        return {key: np.stack(blocks).reshape(length, -1) for key, blocks in self._blocks.items()}

    def discard(self) -> None:
        """Forgets the episode."""
        self.dataset.clear_episode_buffer()
        for blocks in self._blocks.values():
            blocks.clear()

    def drop(self) -> None:
        """Closes what is open, so that LeRobot writes nothing more; for an episode that failed."""
        with contextlib.suppress(Exception):
            self.dataset.clear_episode_buffer()
        self.dataset.meta._metadata_buffer.clear()  # or LeRobot writes the row of an episode that is not there
        with contextlib.suppress(Exception):
            self.dataset.finalize()

    def _copy_metadata(self, root: Path) -> dict[str, Any]:
        """Copies what LeRobot needs in order to continue a dataset. Returns the dataset's features."""
        (self.folder / "meta").mkdir(parents=True)
        info = json.loads((root / INFO_PATH).read_text())
        (self.folder / INFO_PATH).write_text(json.dumps({**info, "features": _without_sound(info["features"])}))
        for name in ("stats.json", "tasks.parquet"):
            if (root / "meta" / name).exists():
                shutil.copyfile(root / "meta" / name, self.folder / "meta" / name)
        for path in sorted(root.glob("meta/episodes/*/*.parquet"))[-1:]:
            table = path.relative_to(root)
            _copy_last_episode(path, self.folder / table)
            self.before.add(table)
        for feature in info["features"].values():
            feature["shape"] = tuple(feature["shape"])
        return info["features"]


def _without_sound(features: dict[str, Any]) -> dict[str, Any]:
    microphones = set(audio_keys(features))
    return {key: deepcopy(feature) for key, feature in features.items() if key not in microphones}


def check_pictures(dataset: LeRobotDataset, streaming: bool) -> None:
    """Whether every picture of the episode in progress is on the disk, whole; LeRobot only logs when one is not.

    Args:
        dataset: The staging dataset.
        streaming: Whether pictures for videos go to the encoder instead of the disk.

    Raises:
        IncompleteEpisodeError: Naming the first one that is not.
    """
    assert dataset.writer is not None
    if dataset.writer.image_writer is not None:
        dataset.writer.image_writer.wait_until_done()
    keys = dataset.meta.image_keys if streaming else dataset.meta.camera_keys
    for key in set(keys) - set(dataset.meta.depth_keys):
        for index in range(dataset.writer.episode_buffer["size"]):
            name = DEFAULT_IMAGE_PATH.format(
                image_key=key, episode_index=dataset.meta.total_episodes, frame_index=index
            )
            if not _ends_with(dataset.root / name, _PNG_END):
                raise IncompleteEpisodeError(f"frame {index} of '{key}' did not reach the disk")


def check_videos(dataset: LeRobotDataset, length: int) -> None:
    """Whether every video of a staged episode has as many frames as the episode; LeRobot may drop some.

    Args:
        dataset: The staging dataset, with one episode saved.
        length: The episode's frames.

    Raises:
        IncompleteEpisodeError: Naming the camera and the numbers.
    """
    for key in dataset.meta.video_keys:
        for path in (dataset.root / "videos" / key).rglob("*.mp4"):
            with av.open(str(path)) as container:
                frames = sum(1 for packet in container.demux(video=0) if packet.size)
            if frames != length:
                raise IncompleteEpisodeError(
                    f"the video of '{key}' has {frames} frames where {length} were recorded: the encoder did not "
                    "keep up, or the disk is full"
                )


def _ends_with(path: Path, ending: bytes) -> bool:
    try:
        with path.open("rb") as file:
            file.seek(-len(ending), os.SEEK_END)
            return file.read() == ending
    except OSError:
        return False


def _copy_last_episode(source: Path, target: Path) -> None:
    """Copies the last row of an episode table without its statistics, which make up nearly all of it."""
    names = [name for name in pq.read_schema(source).names if not name.startswith("stats/")]
    table = pq.read_table(source, columns=names)
    target.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.slice(table.num_rows - 1), target)


@contextlib.contextmanager
def _datasets_cache_in(folder: Path) -> Iterator[None]:
    """Keeps the copies that `datasets` makes of every metadata file out of the user's cache."""
    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE = before
