"""Writing LeRobotDatasets so that a saved episode survives whatever happens next.

LeRobot writes the footers of its parquet files when a recording ends: a process killed before that leaves files that
nothing can read. `DurableWriter` keeps the episode in progress in memory, its pictures compressed. `save_episode` writes
the files that the dataset will have with it beside the dataset, in LeRobot's layout and with LeRobot's functions for
schema, statistics and video, and then moves them into place, so that the dataset on disk is complete at every moment.
"""

import contextlib
import logging
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import RGBEncoderConfig, infer_depth_unit, rgb_encoder_defaults
from lerobot.datasets import CODEBASE_VERSION
from lerobot.datasets.feature_utils import create_empty_dataset_info
from lerobot.datasets.image_writer import image_array_to_pil_image
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.utils import DatasetInfo
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.episode_files import stage_episode
from lerobot_playbyear.datasets.errors import DatasetWriteError, InputError
from lerobot_playbyear.datasets.features import Features, check_features, check_frame, differences, is_depth
from lerobot_playbyear.datasets.files import INFO_PATH, FolderLock, is_listed, list_files
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.info import check_parts, nothing_in
from lerobot_playbyear.datasets.journal import JOURNAL, SCRATCH, finish_journal, lock_dataset, publish, remove_staged
from lerobot_playbyear.datasets.pictures import encode_picture
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.datasets.survey import DatasetDamagedError, survey

logger = logging.getLogger(__name__)

_LOW_DISK_BYTES = 64 * 2**20
_UNCOMPRESSED = 32  # frames whose pictures may wait to be compressed
_THREADS = 4  # that compress pictures
_SAVING = 2  # saving takes this many times the memory of the episode in addition
_SPARE_BYTES = 256 * 2**20


class DurableWriter:
    """Appends episodes to a LeRobotDataset v3.0; each is on disk for good when `save_episode` returns.

    Protocol: the files that the dataset will have with the episode are written into its scratch folder; a journal is
    written (from here on the episode counts); they are moved into place one by one, `meta/info.json` last; the journal
    is removed. After a crash the next writer finishes the moves of a journal it finds and throws other staged files away.
    The dataset loads with plain LeRobot between any two of these steps. Files and folders are synchronised with the disk
    before they are referred to, so that this holds for a power cut.

    The episode in progress is in memory. A save that fails keeps it: make room, and call `save_episode` again. An
    episode that the memory could not hold while it is saved is refused frame by frame; what is there can be saved.

    A dataset in which a quick look, without pictures and sound, finds damage is refused, and nothing in it is touched: to
    repair it may cost episodes, and is for `playbyear-repair`.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder.
        fps: Frames per second.
        features: LeRobot features of what `add_frame` gets, without the ones LeRobot adds itself.
        resume: Append to the dataset in `root` if there is one. Otherwise an existing one is an error.
        robot_type: Noted in a new dataset's metadata; one that notes another is refused.
        rgb_encoder: Codec and quality of video. None: LeRobot's default.

    Raises:
        FileExistsError: `root` holds a dataset, or other files, and `resume` is off.
        ValueError: Nothing can be recorded with these features; or the dataset in `root` has another fps, other
            features or another robot. The message names them.
        DatasetWriteError: `root` cannot be read or written.
        FolderLockedError: Another process is writing to it.
        DatasetDamagedError: The dataset in `root` is damaged; the message says how, and what to do.
        JournalError: What the dataset's scratch folder says is to be moved lies outside the dataset.
    """

    def __init__(
        self,
        repo_id: str,
        root: str | Path,
        fps: int,
        features: dict[str, dict],
        *,
        resume: bool = False,
        robot_type: str | None = None,
        rgb_encoder: RGBEncoderConfig | None = None,
    ):
        check_features(features, fps)
        self.repo_id = repo_id
        self.root = Path(root)
        self.features = features
        self._encoder = rgb_encoder or rgb_encoder_defaults()
        self._lock: FolderLock | None = None
        self._pool = ThreadPoolExecutor(_THREADS)
        self._forget_episode()
        try:
            check_root(self.root, resume=resume)
            self._lock = lock_dataset(self.root)
            finish_journal(self.root)
            if has_dataset(self.root):
                check_undamaged(self.root)
                self._info = load_info(self.root)
                _check_compatible(self.root, self._info, fps, features, robot_type)
            else:
                self._info = _new_info(fps, features, robot_type)
            if remove_staged(self.root):
                logger.warning(
                    f"{self.root}: an episode that had not been saved was removed; the {self.num_episodes} episodes "
                    "before it are complete."
                )
        except BaseException as error:
            self.close()
            if isinstance(error, OSError) and not isinstance(error, FileExistsError):
                raise DatasetWriteError(f"Cannot write to {self.root}: {error.strerror or error}.") from error
            raise

    @property
    def num_episodes(self) -> int:
        """Episodes that were saved."""
        return self._info.total_episodes

    @property
    def num_frames(self) -> int:
        """Their frames, without those of the episode in progress."""
        return self._info.total_frames

    @property
    def longest_episode(self) -> int:
        """About how many frames an episode can have with the memory that is free, if its pictures were not compressed."""
        frame_bytes = sum(_largest_bytes(feature) for feature in self.features.values())
        return max(int((available_memory() - _SPARE_BYTES) / ((1 + _SAVING) * frame_bytes)), 0)

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame to the episode in progress. After an error it is not part of it, and the episode goes on.

        Args:
            frame: A value per feature (numpy arrays of exactly the feature's dtype and shape) and `task`, a string.

        Raises:
            ValueError: The frame does not fit the features, or its sound is none.
            DatasetWriteError: There is not enough memory to save an episode with it; or the episode before is not saved
                yet.
        """
        if self._is_complete:
            index = self.num_episodes
            raise DatasetWriteError(f"Episode {index} is not saved yet: call save_episode again, or discard_episode.")
        check_frame(frame, self._info.features)
        self._check_memory()
        self._frames.append({key: self._kept(key, value) for key, value in frame.items()})
        if len(self._frames) > _UNCOMPRESSED:
            self._finish_frame(self._frames[-1 - _UNCOMPRESSED])

    def save_episode(self) -> int:
        """Writes the episode in progress. Returns its index.

        Raises:
            DatasetWriteError: It could not be written (disk full, permissions), or not be moved to its place. The episodes
                before it are whole, and it is still there: call this again once the cause is gone.
        """
        index = self.num_episodes
        if not self._frames:
            raise DatasetWriteError(f"Episode {index} has no frames: add some before it is saved.")
        self._is_complete = True
        try:
            self._save(index)
        except Exception as error:
            raise DatasetWriteError(self._describe_failure(index, error)) from error
        self._forget_episode()
        return index

    def discard_episode(self) -> None:
        """Forgets the episode in progress.

        Raises:
            DatasetWriteError: It is complete on disk already, and only has to be moved to its place; or may be.
        """
        with contextlib.suppress(OSError):
            if not (self._is_complete and is_listed(self.root, JOURNAL)):
                return self._forget_episode()
        raise DatasetWriteError(
            f"Episode {self.num_episodes} is complete on disk already, or {self.root} cannot be read: call save_episode."
        )

    def close(self) -> None:
        """Drops an episode in progress. Safe to call twice."""
        if self._lock is None:
            return
        if self._is_complete:
            with contextlib.suppress(OSError):  # the next writer tries again
                finish_journal(self.root)
                remove_staged(self.root)
        self._forget_episode()
        self._pool.shutdown(cancel_futures=True)
        self._lock.close()
        self._lock = None

    def __enter__(self) -> "DurableWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _kept(self, key: str, value: Any) -> Any:
        """What is kept of a value until it is saved: a copy, for whoever made it may use its memory again."""
        feature = self._info.features.get(key)
        if feature is None or feature["dtype"] not in ("image", "video"):
            return value.copy() if isinstance(value, np.ndarray) else value
        try:
            picture = image_array_to_pil_image(value).copy()
        except (ValueError, NotImplementedError, TypeError, AttributeError) as error:
            raise InputError(f"'{key}': {error}") from error
        if is_depth(feature):
            feature["info"].setdefault("depth_unit", infer_depth_unit(value.dtype))
        encode = partial(encode_picture, picture, is_depth(feature), 1 if feature["dtype"] == "video" else 6)
        return self._pool.submit(encode)

    def _finish_frame(self, frame: dict[str, Any]) -> None:
        """Waits until the pictures of a frame are compressed."""
        for key, value in frame.items():
            if isinstance(value, Future):
                frame[key] = value.result()
        self._n_bytes += sum(len(value) for value in frame.values() if isinstance(value, bytes))
        self._n_bytes += sum(value.nbytes for value in frame.values() if isinstance(value, np.ndarray))

    def _check_memory(self) -> None:
        n_frames = len(self._frames)
        if n_frames % _UNCOMPRESSED == 0 and available_memory() < _SAVING * self._n_bytes + _SPARE_BYTES:
            raise DatasetWriteError(
                f"Episode {self.num_episodes} has {n_frames} frames ({n_frames / self._info.fps:.0f} s, "
                f"{self._n_bytes / 2**30:.1f} GB). The free memory is not enough to save a longer one. Save it now, or give "
                "it up with discard_episode; record shorter episodes, or smaller pictures."
            )

    def _save(self, index: int) -> None:
        """Does what is left to be done of a save; after a failure, or an interrupt, it can be called again."""
        finish_journal(self.root)
        info = self._info_on_disk()
        if info.total_episodes == index:
            for frame in self._frames[-_UNCOMPRESSED:]:
                self._finish_frame(frame)
            info.features = deepcopy(self._info.features)
            stage_episode(self.root, info, self._frames, self._encoder)
            publish(self.root)
            info = self._info_on_disk()
        if info.total_episodes != index + 1:
            raise OSError(
                f"{self.root} holds {info.total_episodes} episodes where {index} were before: something else changed it, or "
                "its drive is gone"
            )
        self._info = info

    def _info_on_disk(self) -> DatasetInfo:
        is_new = self.num_episodes == 0 and not is_listed(self.root, INFO_PATH)
        return deepcopy(self._info) if is_new else load_info(self.root)

    def _forget_episode(self) -> None:
        self._frames: list[dict[str, Any]] = []
        self._n_bytes = 0
        self._is_complete = False  # whether saving has begun, so that no frame can be added any more

    def _describe_failure(self, index: int, error: Exception) -> str:
        reason = f"{type(error).__name__}: {error}"
        with contextlib.suppress(OSError):
            if shutil.disk_usage(self.root).free < _LOW_DISK_BYTES:
                reason = f"the disk is full ({reason})"
        if os.path.lexists(self.root / JOURNAL):  # it never raises
            return (
                f"Episode {index} is complete on disk, but could not be moved to its place in {self.root}: {reason}. "
                "It is there as soon as save_episode is called again, or the dataset is opened with --resume=true, and the "
                "cause is gone."
            )
        return (
            f"Episode {index} could not be written to {self.root}: {reason}. The {index} episodes before it are complete. "
            "Once the cause is gone, call save_episode again; a program that has ended goes on with --resume=true, and "
            "records this episode again."
        )


# What is there already


def check_root(root: Path, *, resume: bool) -> None:
    """Whether a dataset can be written to `root`.

    Raises:
        FileExistsError: It holds a dataset and `resume` is off, or it holds other files.
        DatasetWriteError: It is a file.
    """
    if root.exists() and not root.is_dir():
        raise DatasetWriteError(f"Cannot write a dataset to {root}: it is a file.")
    if has_dataset(root):
        if not resume:
            raise FileExistsError(f"{root} already holds a dataset. Append with --resume=true, or choose another root.")
    elif root.is_dir() and any(path.name != SCRATCH.name for path in root.iterdir()):
        raise FileExistsError(f"{nothing_in(root)}. Choose another root, or an empty one.")


def has_dataset(root: Path) -> bool:
    """Whether a folder holds a LeRobotDataset, however damaged.

    Raises:
        OSError: It, or a folder in it, cannot be listed: that says nothing of what it holds.
    """
    try:
        os.listdir(root)
    except FileNotFoundError:
        return False
    return any(list_files(root, name) for name in (INFO_PATH, str(JOURNAL), "data/chunk-*/file-*", "meta/episodes/*/*"))


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
    if not found.is_undamaged:
        try:
            check_parts(root)
        except InputError as error:
            raise DatasetDamagedError(str(error)) from error
        command = repair_command(root)
        raise DatasetDamagedError(
            f"{found}\nNothing was changed, and nothing is appended to a damaged dataset. `{command} --dry_run=true` looks "
            f"again, more closely, and `{command}` writes a copy with the episodes that are whole."
        )


def _check_compatible(root: Path, info: DatasetInfo, fps: int, features: Features, robot: str | None) -> None:
    """Whether frames of `features` at `fps`, of a robot of this type, can be appended to an existing dataset."""
    found = [f"fps is {info.fps} there and {fps} here"] if info.fps != fps else []
    found += differences(info.features, features)
    if info.robot_type and robot and info.robot_type != robot:
        found.append(f"the robot is {info.robot_type} there and {robot} here")
    if found:
        raise InputError(
            f"The dataset in {root} does not fit what is to be appended: {'; '.join(found)}. "
            "Record with the same settings, or choose another root."
        )


def _new_info(fps: int, features: Mapping[str, dict], robot_type: str | None) -> DatasetInfo:
    own = {key: {**deepcopy(feature), "shape": tuple(feature["shape"])} for key, feature in features.items()}
    has_films = any(feature["dtype"] == "video" for feature in features.values())
    return create_empty_dataset_info(CODEBASE_VERSION, fps, {**own, **DEFAULT_FEATURES}, has_films, robot_type)


def _largest_bytes(feature: Mapping[str, Any]) -> int:
    """What a value of a feature takes in memory, at most; of pictures that are noise, about."""
    n_values = int(np.prod(feature["shape"]))
    kind = feature["dtype"]
    if kind in ("image", "video"):
        return n_values
    return n_values * np.dtype(kind).itemsize if kind not in ("string", "language") else 100
