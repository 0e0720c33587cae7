"""Writing LeRobotDatasets so that a saved episode survives whatever happens next.

LeRobot writes the footers of its parquet files when a recording ends: a process killed before that leaves files that
nothing can read. `DurableWriter` writes each episode with LeRobot's own public calls into a small dataset beside the
real one and then moves the finished files over, so that the dataset on disk is complete at every moment.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import datasets
import pyarrow.parquet as pq
from filelock import FileLock, Timeout
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import DEFAULT_FEATURES
from lerobot.utils.utils import SuppressProgressBars

# Everything of ours lives under LeRobot's scratch folder for frames, which push_to_hub leaves out.
_SCRATCH = Path("images")
_STAGING = _SCRATCH / ".staging"
_JOURNAL = _SCRATCH / ".journal.json"
_LOCK = _SCRATCH / ".lock"
_INFO = Path("meta/info.json")
_LOW_DISK_BYTES = 64 * 2**20


class DatasetWriteError(RuntimeError):
    """An episode could not be written; the episodes saved before it are complete on disk."""


class DurableWriter:
    """Appends episodes to a LeRobotDataset v3.0; each is on disk for good when `save_episode` returns.

    Protocol: LeRobot writes the episode into a staging dataset inside the root and closes its files; a journal that
    names these files is written (from here on the episode counts); the files are moved into place one by one,
    `meta/info.json` last; the journal is removed. After a crash the next writer finishes the moves of a journal it
    finds and throws other staged files away. The dataset loads with plain LeRobot between any two of these steps.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder.
        fps: Frames per second.
        features: LeRobot features of what `add_frame` gets, without the ones LeRobot adds itself.
        resume: Append to the dataset in `root` if there is one. Otherwise an existing one is an error.
        robot_type: Noted in a new dataset's metadata.
        image_writer_threads: Threads that compress pictures. 0: `add_frame` does it.

    Raises:
        FileExistsError: `root` holds a dataset, or other files, and `resume` is off.
        ValueError: The dataset in `root` has another fps or other features; the message names the differences.
        DatasetWriteError: `root` cannot be written, or another process is writing to it.
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
    ):
        self.repo_id = repo_id
        self.root = Path(root)
        self.features = features
        self._image_writer_threads = image_writer_threads
        self._create_options: dict[str, Any] = {
            "fps": fps,
            "features": deepcopy(features),
            "robot_type": robot_type,
            "use_videos": any(feature["dtype"] == "video" for feature in features.values()),
        }
        check_root(self.root, resume=resume)
        self._lock = self._acquire_lock()
        try:
            self._finish_journal()
            if self._has_dataset():
                check_compatible(LeRobotDatasetMetadata(repo_id, root=self.root), fps, features)
            self._staging = self._open_staging()
        except BaseException:
            self._lock.release()
            raise

    @property
    def num_episodes(self) -> int:
        """Episodes on disk."""
        return self._staging.meta.total_episodes

    @property
    def num_frames(self) -> int:
        """Frames on disk, without those of the episode in progress."""
        return self._staging.meta.total_frames

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame to the episode in progress.

        Args:
            frame: A value per feature (numpy arrays of exactly the feature's dtype and shape) and `task`, a string.

        Raises:
            ValueError: The frame does not fit the features.
        """
        self._staging.add_frame(frame)

    def save_episode(self) -> int:
        """Writes the episode in progress. Returns its index.

        Raises:
            DatasetWriteError: It could not be written (disk full, permissions). The dataset is as it was before.
        """
        index = self.num_episodes
        try:
            with SuppressProgressBars():
                self._staging.save_episode(parallel_encoding=False)
            self._staging.finalize()
            self._publish()
            self._staging = self._open_staging()
        except Exception as error:
            raise DatasetWriteError(self._describe_failure(index, error)) from error
        return index

    def discard_episode(self) -> None:
        """Forgets the episode in progress."""
        self._staging.clear_episode_buffer()

    def close(self) -> None:
        """Drops an episode in progress and removes what was needed only for writing. Safe to call twice."""
        if not self._lock.is_locked:
            return
        with contextlib.suppress(Exception):
            self._staging.finalize()
        shutil.rmtree(self.root / _STAGING, ignore_errors=True)
        self._lock.release()
        (self.root / _LOCK).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            (self.root / _SCRATCH).rmdir()

    def __enter__(self) -> "DurableWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Staging

    def _has_dataset(self) -> bool:
        return (self.root / _INFO).is_file()

    def _acquire_lock(self) -> FileLock:
        try:
            (self.root / _SCRATCH).mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.root / _LOCK, timeout=0)
            lock.acquire()
        except Timeout:
            raise DatasetWriteError(f"Another process is writing to {self.root}: wait until it has ended.") from None
        except OSError as error:
            raise DatasetWriteError(f"Cannot write to {self.root}: {error.strerror or error}.") from error
        return lock

    def _open_staging(self) -> LeRobotDataset:
        """A dataset that continues the real one, with nothing but the metadata that LeRobot needs to do so."""
        staging = self.root / _STAGING
        shutil.rmtree(staging, ignore_errors=True)
        if not self._has_dataset():
            dataset = LeRobotDataset.create(
                self.repo_id,
                root=staging,
                video_backend="pyav",
                image_writer_threads=self._image_writer_threads,
                **self._create_options,
            )
            self._staged_before: set[Path] = set()
            return dataset
        (staging / "meta").mkdir(parents=True)
        for name in ("info.json", "stats.json", "tasks.parquet"):
            if (self.root / "meta" / name).exists():
                shutil.copyfile(self.root / "meta" / name, staging / "meta" / name)
        self._staged_before = set()
        for path in sorted(self.root.glob("meta/episodes/*/*.parquet"))[-1:]:
            table = path.relative_to(self.root)
            _copy_last_episode(path, staging / table)
            self._staged_before.add(table)
        with _datasets_cache_in(staging / ".cache"), SuppressProgressBars():
            return LeRobotDataset.resume(
                self.repo_id,
                root=staging,
                video_backend="pyav",
                image_writer_threads=self._image_writer_threads,
            )

    def _publish(self) -> None:
        staging = self.root / _STAGING
        folders = [staging / name for name in ("data", "videos", "meta")]
        paths = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
        names = [path.relative_to(staging) for path in paths]
        names = [name for name in names if name not in self._staged_before and name != _INFO] + [_INFO]
        for name in names:
            _flush(staging / name)
        journal = self.root / _JOURNAL
        partial = journal.with_suffix(".partial")
        partial.write_text(json.dumps([str(name) for name in names]))
        _flush(partial)
        os.replace(partial, journal)
        _flush(journal.parent)
        self._finish_journal()

    def _finish_journal(self) -> None:
        """Moves what the journal names into place. Does the rest of the work where a crash interrupted it."""
        journal = self.root / _JOURNAL
        if not journal.exists():
            return
        for name in json.loads(journal.read_text()):
            source, target = self.root / _STAGING / name, self.root / name
            if source.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(source, target)
                _flush(target.parent)
        journal.unlink()
        _flush(journal.parent)

    def _describe_failure(self, index: int, error: Exception) -> str:
        reason = f"{type(error).__name__}: {error}"
        with contextlib.suppress(OSError):
            if shutil.disk_usage(self.root).free < _LOW_DISK_BYTES:
                reason = f"the disk is full ({reason})"
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
    if (root / _INFO).is_file() or (root / _JOURNAL).is_file():
        if not resume:
            raise FileExistsError(
                f"{root} already holds a dataset. Append to it with resume=true, or choose another root."
            )
    elif root.is_dir() and any(path.name != _SCRATCH.name for path in root.iterdir()):
        raise FileExistsError(f"{root} is not empty and holds no dataset. Choose another root.")


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


def _copy_last_episode(source: Path, target: Path) -> None:
    """Copies the last row of an episode table without its statistics, which make up nearly all of it."""
    names = [name for name in pq.read_schema(source).names if not name.startswith("stats/")]
    table = pq.read_table(source, columns=names)
    target.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.slice(table.num_rows - 1), target)


def _flush(path: Path) -> None:
    """Asks the operating system to put a file, or the entries of a folder, on the disk itself."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _datasets_cache_in(folder: Path) -> Iterator[None]:
    """Keeps the copies that `datasets` makes of every metadata file out of the user's cache."""
    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE = before
