"""A dataset beside the real one, into which one episode is written: by LeRobot all but its sound."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.dataset_writer import DatasetWriter
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import INFO_PATH
from lerobot.utils.constants import DEFAULT_FEATURES
from lerobot.utils.utils import SuppressProgressBars
from torch import Tensor

from lerobot_playbyear.compat import forget_unsaved_rows
from lerobot_playbyear.datasets.episode_checks import check_pictures, check_videos
from lerobot_playbyear.datasets.features import audio_keys, check_frame
from lerobot_playbyear.datasets.files import take_over
from lerobot_playbyear.datasets.journal import EPISODE, PICTURES, SCRATCH, STAGING


class Staging:
    """An episode in progress.

    LeRobot writes it to a dataset of its own that continues the real one. The sound does not take that way, on which
    every sample would become a Python number and every sample index get statistics: it is kept here, and
    `settle_episode` adds it.

    LeRobot's saving uses up the frames as it goes. So they are put aside before, pictures as second links to their
    files: a save that failed begins again with a dataset as fresh as the first one, and all frames.

    Args:
        repo_id: The dataset's name.
        root: The real dataset's folder. Where it holds none, the staging dataset is a new one. What is left of another
            episode in progress there is removed.
        create_options: For `LeRobotDataset.create`, besides `write_options`.
        write_options: For `LeRobotDataset.create` and `LeRobotDataset.resume`.

    Attributes:
        folder: The staging dataset's folder.
        dataset: The staging dataset.
        features: All features, as `meta/info.json` has them.
        index: The episode's number.
        before: Files that were put there for LeRobot to continue from, relative to `folder`.
    """

    def __init__(self, repo_id: str, root: Path, create_options: dict[str, Any], write_options: dict[str, Any]) -> None:
        self.folder = root / EPISODE
        self._repo_id, self._root, self._pictures = repo_id, root, root / PICTURES
        self._create_options, self._write_options = create_options, write_options
        self._frames: dict[str, Any] | None = None  # what LeRobot had of the episode before it was first saved
        self._is_saved = False
        remove_leftovers(root)
        self._open()
        self.index = self.dataset.meta.total_episodes
        self._blocks: dict[str, list[np.ndarray]] = {key: [] for key in audio_keys(self.features)}

    @property
    def length(self) -> int:
        """The frames of the episode so far."""
        if self._frames is not None:
            return self._frames["size"]
        return 0 if self._writer.episode_buffer is None else self._writer.episode_buffer["size"]

    @property
    def is_complete(self) -> bool:
        """Whether saving has begun, so that no frame can be added any more."""
        return self._frames is not None

    @property
    def _writer(self) -> DatasetWriter:
        return cast(DatasetWriter, self.dataset.writer)

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame, or none of it where that fails.

        Raises:
            ValueError: It does not fit the features.
        """
        values = {key: value.numpy() if isinstance(value, Tensor) else value for key, value in frame.items()}
        check_frame(values, self.features)
        try:
            self.dataset.add_frame({key: value for key, value in values.items() if key not in self._blocks})
        except BaseException:
            self._forget_half_frame()
            raise
        for key, blocks in self._blocks.items():
            blocks.append(values[key].copy())  # a sound card may use its buffer again

    def save(self) -> dict[str, np.ndarray]:
        """Has LeRobot write the episode and close its files. After a failure it can be called again.

        Returns:
            The sound of each microphone, (n_frames, S).

        Raises:
            LostFramesError: Pictures are missing; calling it again will not do.
            IncompleteEpisodeError: Pictures did not get into a video.
        """
        if self._frames is None:
            self._put_frames_aside()
        elif not self._is_saved:
            self._begin_again()
        if not self._is_saved:
            with SuppressProgressBars():
                self.dataset.save_episode(parallel_encoding=False)
            self.dataset.finalize()
            check_videos(self.dataset, self.length)
            self._is_saved = True
        shutil.rmtree(self._pictures, ignore_errors=True)  # LeRobot's files hold them now
        return {key: np.stack(blocks).reshape(self.length, -1) for key, blocks in self._blocks.items()}

    def discard(self) -> None:
        """Forgets the episode."""
        self.dataset.clear_episode_buffer()
        for blocks in self._blocks.values():
            blocks.clear()

    def drop(self) -> None:
        """Closes what is open, so that LeRobot writes nothing more; for an episode that is given up."""
        with contextlib.suppress(Exception):
            self.dataset.clear_episode_buffer()
        forget_unsaved_rows(self.dataset.meta)  # or LeRobot writes the row of an episode that is not there
        with contextlib.suppress(Exception):
            self.dataset.finalize()

    def _put_frames_aside(self) -> None:
        check_pictures(self.dataset)
        shutil.rmtree(self._pictures / SCRATCH, ignore_errors=True)  # of a try that was interrupted
        if (self.folder / SCRATCH).is_dir():
            shutil.copytree(self.folder / SCRATCH, self._pictures / SCRATCH, copy_function=take_over)
        self._frames = dict(self._writer.episode_buffer)

    def _begin_again(self) -> None:
        """Gives the frames to a fresh dataset; LeRobot's cannot be used any more after an error."""
        self.drop()
        shutil.rmtree(self.folder)
        self._open()
        if (self._pictures / SCRATCH).is_dir():
            shutil.copytree(self._pictures / SCRATCH, self.folder / SCRATCH, copy_function=take_over)
        assert self._frames is not None
        self._writer.episode_buffer = dict(self._frames)

    def _forget_half_frame(self) -> None:
        buffer = self._writer.episode_buffer
        for values in (buffer or {}).values():
            if isinstance(values, list):
                del values[buffer["size"] :]

    def _open(self) -> None:
        self.before: set[Path] = set()
        if (self._root / INFO_PATH).is_file():
            self.features = self._copy_metadata(self._root)
            with _datasets_cache_in(self.folder / ".cache"), SuppressProgressBars():
                self.dataset = LeRobotDataset.resume(self._repo_id, root=self.folder, **self._write_options)
        else:
            self.features = {**deepcopy(self._create_options["features"]), **DEFAULT_FEATURES}
            own = {**self._create_options, "features": _without_sound(self._create_options["features"])}
            self.dataset = LeRobotDataset.create(self._repo_id, root=self.folder, **own, **self._write_options)

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
            (self.folder / table).parent.mkdir(parents=True)
            pq.write_table(last_episode(path), self.folder / table)
            self.before.add(table)
        for feature in info["features"].values():
            feature["shape"] = tuple(feature["shape"])
        return info["features"]


def _without_sound(features: dict[str, Any]) -> dict[str, Any]:
    microphones = set(audio_keys(features))
    return {key: deepcopy(feature) for key, feature in features.items() if key not in microphones}


def remove_leftovers(root: Path) -> bool:
    """Removes an episode in progress from a dataset's scratch folder. Returns whether anything of one was there."""
    has_frames = any((root / name).exists() for name in (EPISODE / "images", EPISODE / "data", PICTURES, STAGING))
    for folder in (root / EPISODE, root / PICTURES, root / STAGING):
        if folder.exists():
            shutil.rmtree(folder)
    return has_frames


def last_episode(path: Path) -> pa.Table:
    """The last row of a table of episodes without its statistics, which make up nearly all of it."""
    names = [name for name in pq.read_schema(path).names if not name.startswith("stats/")]
    table = pq.read_table(path, columns=names)
    return table.slice(table.num_rows - 1)


@contextlib.contextmanager
def _datasets_cache_in(folder: Path) -> Iterator[None]:
    """Keeps the copies that `datasets` makes of every metadata file out of the user's cache."""
    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE = before
