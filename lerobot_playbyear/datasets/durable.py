"""Writing LeRobotDatasets so that a saved episode survives whatever happens next.

LeRobot writes the footers of its parquet files when a recording ends: a process killed before that leaves files that
nothing can read. `DurableWriter` writes each episode with LeRobot's own public calls into a small dataset beside the
real one and then moves the finished files over, so that the dataset on disk is complete at every moment.
"""

import contextlib
import logging
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_playbyear.datasets.journal import JOURNAL, LOCK, SCRATCH, STAGING, finish_journal, publish
from lerobot_playbyear.datasets.repair import RepairReport, repair_dataset
from lerobot_playbyear.datasets.repair.repairing import finish_repair
from lerobot_playbyear.datasets.settling import INFO, settle_episode
from lerobot_playbyear.datasets.staging import IncompleteEpisodeError, Staging

logger = logging.getLogger(__name__)

_LOW_DISK_BYTES = 64 * 2**20


class DatasetWriteError(RuntimeError):
    """An episode could not be written; the episodes saved before it are complete on disk."""


class DurableWriter:
    """Appends episodes to a LeRobotDataset v3.0; each is on disk for good when `save_episode` returns.

    Protocol: LeRobot writes the episode, all but its sound, into a staging dataset inside the root and closes its
    files; the sound is added; a journal that
    names these files is written (from here on the episode counts); the files are moved into place one by one,
    `meta/info.json` last; the journal is removed. After a crash the next writer finishes the moves of a journal it
    finds and throws other staged files away. The dataset loads with plain LeRobot between any two of these steps.
    Files and folders are synchronised with the disk before they are referred to, so that this holds for a power cut.

    A dataset that another tool left half-written is repaired when it is opened (`repair_dataset`), and what was found
    is logged as a warning and kept in `repair`.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder.
        fps: Frames per second.
        features: LeRobot features of what `add_frame` gets, without the ones LeRobot adds itself.
        resume: Append to the dataset in `root` if there is one. Otherwise an existing one is an error.
        robot_type: Noted in a new dataset's metadata.
        image_writer_threads: Threads that compress pictures. 0: `add_frame` does it.
        streaming_encoding: Encode video while frames come in, not in `save_episode`. An episode of which the encoder
            dropped a frame is refused.
        rgb_encoder: Codec and quality of video. None: LeRobot's default.

    Attributes:
        repair: What was repaired when the dataset was opened; None if nothing was.

    Raises:
        FileExistsError: `root` holds a dataset, or other files, and `resume` is off.
        ValueError: The dataset in `root` has another fps or other features; the message names the differences.
        DatasetWriteError: `root` cannot be written, or another process is writing to it.
        DatasetDamagedError: The dataset in `root` is damaged beyond repair; the message says what is missing.
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
        image_writer_threads: int = 4,
        streaming_encoding: bool = False,
        rgb_encoder: RGBEncoderConfig | None = None,
    ):
        self.repo_id = repo_id
        self.root = Path(root)
        self.features = features
        self.repair: RepairReport | None = None
        self._create_options: dict[str, Any] = {
            "fps": fps,
            "features": deepcopy(features),
            "robot_type": robot_type,
            "use_videos": any(feature["dtype"] == "video" for feature in features.values()),
        }
        self._write_options: dict[str, Any] = {
            "video_backend": "pyav",
            "image_writer_threads": image_writer_threads,
            "streaming_encoding": streaming_encoding,
            "rgb_encoder": rgb_encoder,
        }
        self._episode: Staging | None = None
        self._lock: FileLock | None = None
        try:
            finish_repair(self.root)
            check_root(self.root, resume=resume)
            self._lock = self._acquire_lock()
            finish_journal(self.root)
            if has_dataset(self.root):
                self._check_and_repair(fps, features)
            self._meta = self._staging.dataset.meta
        except BaseException as error:
            if self._lock is not None:
                self._lock.release()
            if isinstance(error, OSError) and not isinstance(error, FileExistsError):
                raise DatasetWriteError(f"Cannot write to {self.root}: {error.strerror or error}.") from error
            raise

    @property
    def num_episodes(self) -> int:
        """Episodes on disk."""
        return self._meta.total_episodes

    @property
    def num_frames(self) -> int:
        """Frames on disk, without those of the episode in progress."""
        return self._meta.total_frames

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame to the episode in progress.

        Args:
            frame: A value per feature (numpy arrays of exactly the feature's dtype and shape) and `task`, a string.

        Raises:
            ValueError: The frame does not fit the features.
            DatasetWriteError: The disk does not take it.
        """
        try:
            self._staging.add_frame(frame)
        except (OSError, RuntimeError) as error:
            raise DatasetWriteError(self._describe_failure(self.num_episodes, error)) from error

    def save_episode(self) -> int:
        """Writes the episode in progress. Returns its index.

        Raises:
            DatasetWriteError: It could not be written (disk full, permissions). The dataset is as it was before.
        """
        index, episode = self.num_episodes, self._staging
        try:
            sound = episode.save()
            publish(self.root, settle_episode(self.root, episode, sound))
        except Exception as error:
            self._drop_staging()
            raise DatasetWriteError(self._describe_failure(index, error)) from error
        self._episode = None
        self._meta = episode.dataset.meta
        with contextlib.suppress(OSError):  # the next frame tries again, and says why it cannot
            self._meta = self._staging.dataset.meta
        return index

    def discard_episode(self) -> None:
        """Forgets the episode in progress."""
        self._staging.discard()

    def close(self) -> None:
        """Drops an episode in progress and removes what was needed only for writing. Safe to call twice."""
        if self._lock is None or not self._lock.is_locked:
            return
        self._drop_staging()
        if not (self.root / JOURNAL).exists():
            shutil.rmtree(self.root / STAGING, ignore_errors=True)
        self._lock.release()
        with contextlib.suppress(OSError):
            (self.root / LOCK).unlink(missing_ok=True)
            (self.root / SCRATCH).rmdir()

    def __enter__(self) -> "DurableWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _acquire_lock(self) -> FileLock:
        (self.root / SCRATCH).mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.root / LOCK, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            raise DatasetWriteError(f"Another process is writing to {self.root}: wait until it has ended.") from None
        return lock

    def _check_and_repair(self, fps: int, features: dict[str, dict]) -> None:
        report = repair_dataset(self.root, fps=fps, features=features, thorough=False, has_lock=True)
        if report.changed:
            logger.warning("%s", report)
            self.repair = report
            if self._lock is not None:
                self._lock.release()  # of the folder that was put aside
            self._lock = self._acquire_lock()
        check_compatible(LeRobotDatasetMetadata(self.repo_id, root=self.root), fps, features)

    @property
    def _staging(self) -> Staging:
        """The episode in progress; a fresh one after every episode that was saved."""
        if self._episode is None:
            finish_journal(self.root)
            folder = self.root / STAGING
            self._episode = Staging(self.repo_id, self.root, folder, self._create_options, self._write_options)
        return self._episode

    def _drop_staging(self) -> None:
        if self._episode is not None:
            self._episode.drop()
            self._episode = None

    def _describe_failure(self, index: int, error: Exception) -> str:
        reason = str(error) if isinstance(error, IncompleteEpisodeError) else f"{type(error).__name__}: {error}"
        with contextlib.suppress(OSError):
            if shutil.disk_usage(self.root).free < _LOW_DISK_BYTES:
                reason = f"the disk is full ({reason})"
        if (self.root / JOURNAL).exists():
            return (
                f"Episode {index} is complete on disk, but could not be moved to its place in {self.root}: {reason}. "
                "It is there as soon as the dataset is opened with resume=true and the cause is gone."
            )
        return (
            f"Episode {index} could not be written to {self.root}: {reason}. "
            f"The {index} episodes before it are complete; go on with resume=true once the cause is gone."
        )


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
    """Whether a folder holds a LeRobotDataset, however damaged."""
    return (root / INFO).is_file() or any(root.glob("data/chunk-*/file-*")) or any(root.glob("meta/episodes/*/*"))


def check_compatible(meta: LeRobotDatasetMetadata, fps: int, features: dict[str, dict]) -> None:
    """Whether frames of `features` at `fps` can be appended to an existing dataset.

    Raises:
        ValueError: With every difference in the message.
    """
    differences = []
    if meta.fps != fps:
        differences.append(f"fps is {meta.fps} there and {fps} here")
    there = {key: _signature(value) for key, value in meta.features.items() if key not in DEFAULT_FEATURES}
    here = {key: _signature(value) for key, value in features.items() if key not in DEFAULT_FEATURES}
    differences += [
        f"{key} is {there.get(key, 'absent')} there and {here.get(key, 'absent')} here"
        for key in sorted(there.keys() | here.keys())
        if there.get(key) != here.get(key)
    ]
    if differences:
        raise ValueError(
            f"The dataset in {meta.root} does not fit what is to be appended: {'; '.join(differences)}. "
            "Record with the same settings, or choose another root."
        )


def _signature(feature: dict) -> str:
    rate = (feature.get("info") or {}).get("sample_rate")
    return f"{feature['dtype']} {tuple(feature['shape'])}" + (f" at {rate} Hz" if rate else "")
