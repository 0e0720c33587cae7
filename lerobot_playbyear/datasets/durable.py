"""Writing LeRobotDatasets so that a saved episode survives whatever happens next.

LeRobot writes the footers of its parquet files when a recording ends: a process killed before that leaves files that
nothing can read. `DurableWriter` writes each episode with LeRobot's own public calls into a small dataset beside the
real one and then moves the finished files over, so that the dataset on disk is complete at every moment.
"""

import contextlib
import json
import logging
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_playbyear.datasets.episode_checks import IncompleteEpisodeError, LostFramesError
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.existing import check_compatible, check_root, check_undamaged, has_dataset
from lerobot_playbyear.datasets.features import check_features
from lerobot_playbyear.datasets.files import FolderLock
from lerobot_playbyear.datasets.journal import JOURNAL, finish_journal, lock_dataset, publish
from lerobot_playbyear.datasets.settling import INFO, settle_episode
from lerobot_playbyear.datasets.staging import Staging, remove_leftovers

logger = logging.getLogger(__name__)

_LOW_DISK_BYTES = 64 * 2**20


class DurableWriter:
    """Appends episodes to a LeRobotDataset v3.0; each is on disk for good when `save_episode` returns.

    Protocol: LeRobot writes the episode, all but its sound, into a dataset inside the root's scratch folder and closes
    its files; of these and the sound the files are made that the dataset shall hold; a journal
    is written (from here on the episode counts); they are moved into place one by one,
    `meta/info.json` last; the journal is removed. After a crash the next writer finishes the moves of a journal it
    finds and throws other staged files away. The dataset loads with plain LeRobot between any two of these steps.
    Files and folders are synchronised with the disk before they are referred to, so that this holds for a power cut.

    A save that fails keeps the episode: make room, and call `save_episode` again.

    A dataset with any other damage is refused, and nothing in it is touched: to repair it may cost episodes, and is for
    `playbyear-repair`.

    Args:
        repo_id: Name of the dataset, `user/name`.
        root: Its folder.
        fps: Frames per second.
        features: LeRobot features of what `add_frame` gets, without the ones LeRobot adds itself.
        resume: Append to the dataset in `root` if there is one. Otherwise an existing one is an error.
        robot_type: Noted in a new dataset's metadata; one that notes another is refused.
        image_writer_threads: Threads that compress pictures. 0: `add_frame` does it.
        rgb_encoder: Codec and quality of video. None: LeRobot's default.

    Raises:
        FileExistsError: `root` holds a dataset, or other files, and `resume` is off.
        ValueError: Nothing can be recorded with these features; or the dataset in `root` has another fps, other
            features or another robot. The message names them.
        DatasetWriteError: `root` cannot be read or written, or another process is writing to it.
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
        image_writer_threads: int = 4,
        rgb_encoder: RGBEncoderConfig | None = None,
    ):
        check_features(features, fps)
        self.repo_id = repo_id
        self.root = Path(root)
        self.features = features
        self._create_options: dict[str, Any] = {
            "fps": fps,
            "features": deepcopy(features),
            "robot_type": robot_type,
            "use_videos": any(feature["dtype"] == "video" for feature in features.values()),
        }
        self._write_options: dict[str, Any] = {
            "video_backend": "pyav",
            "image_writer_threads": image_writer_threads,
            "rgb_encoder": rgb_encoder,
        }
        self._n_episodes = self._n_frames = 0
        self._episode: Staging | None = None
        self._lock: FolderLock | None = None
        try:
            check_root(self.root, resume=resume)
            self._lock = lock_dataset(self.root)
            finish_journal(self.root)
            if has_dataset(self.root):
                check_undamaged(self.root)
                check_compatible(LeRobotDatasetMetadata(self.repo_id, root=self.root), fps, features, robot_type)
            self._count()
            if remove_leftovers(self.root):
                logger.warning(
                    f"{self.root}: an episode that had not been saved was removed; the {self.num_episodes} episodes "
                    "before it are complete."
                )
            self._staging  # noqa: B018  (so that what goes wrong with it goes wrong now)
        except BaseException as error:
            if self._lock is not None:
                self._lock.release()
            if isinstance(error, OSError) and not isinstance(error, FileExistsError):
                raise DatasetWriteError(f"Cannot write to {self.root}: {error.strerror or error}.") from error
            raise

    @property
    def num_episodes(self) -> int:
        """Episodes on disk."""
        return self._n_episodes

    @property
    def num_frames(self) -> int:
        """Frames on disk, without those of the episode in progress."""
        return self._n_frames

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Adds one frame to the episode in progress. After an error it is not part of it, and the episode goes on.

        Args:
            frame: A value per feature (numpy arrays of exactly the feature's dtype and shape) and `task`, a string.

        Raises:
            ValueError: The frame does not fit the features, or its sound is none.
            DatasetWriteError: The disk does not take it; or the episode before is not saved yet.
        """
        try:
            staging = self._staging
            if staging.is_complete:
                raise DatasetWriteError(
                    f"Episode {staging.index} is not saved yet: call save_episode again, or give it up with "
                    "discard_episode.",
                    can_be_repeated=True,
                )
            staging.add_frame(frame)
        except DatasetWriteError:
            raise
        except (OSError, RuntimeError) as error:
            raise DatasetWriteError(self._describe_failure(self.num_episodes, error)) from error

    def save_episode(self) -> int:
        """Writes the episode in progress. Returns its index.

        Raises:
            DatasetWriteError: It could not be written (disk full, permissions). The dataset is as it was before. Where
                the error's `can_be_repeated` is true, so is the episode: call this again once the cause is gone.
        """
        if self._episode is None or self._episode.length == 0:
            raise DatasetWriteError(f"Episode {self.num_episodes} has no frames: add some before it is saved.")
        episode = self._episode
        try:
            self._save(episode)
        except LostFramesError as error:
            self._drop_staging()
            raise DatasetWriteError(self._describe_failure(episode.index, error)) from error
        except Exception as error:
            raise DatasetWriteError(self._describe_failure(episode.index, error), can_be_repeated=True) from error
        finally:
            with contextlib.suppress(OSError):
                self._count()
        self._episode = None
        with contextlib.suppress(OSError):  # the next frame tries again, and says why it cannot
            self._staging  # noqa: B018
        return episode.index

    def discard_episode(self) -> None:
        """Forgets the episode in progress.

        Raises:
            DatasetWriteError: It is complete on disk already, and only has to be moved to its place.
        """
        if (self.root / JOURNAL).exists():
            raise DatasetWriteError(
                f"Episode {self.num_episodes} is complete on disk already: call save_episode again.",
                can_be_repeated=True,
            )
        if self._episode is not None and self._episode.is_complete:
            self._drop_staging()
        else:
            self._staging.discard()

    def close(self) -> None:
        """Drops an episode in progress and removes what was needed only for writing. Safe to call twice."""
        if self._lock is None:
            return
        self._drop_staging()
        with contextlib.suppress(OSError):  # the next writer tries again
            finish_journal(self.root)
            remove_leftovers(self.root)
        self._lock.release()
        self._lock = None

    def __enter__(self) -> "DurableWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _save(self, episode: Staging) -> None:
        """Does what is left to be done of a save; after a failure, or an interrupt, it can be called again."""
        self._count()
        if (self.root / JOURNAL).exists():
            finish_journal(self.root)
        elif self.num_episodes == episode.index:
            settle_episode(self.root, episode, episode.save())
            publish(self.root)
        elif self.num_episodes != episode.index + 1:
            raise _another_count(self.root, self.num_episodes, episode.index)

    def _count(self) -> None:
        """Takes the numbers from the disk: those of LeRobot's staging dataset are ahead of it while it saves."""
        path = self.root / INFO
        if self._n_episodes or path.is_file():
            info = json.loads(path.read_text())
            self._n_episodes, self._n_frames = info["total_episodes"], info["total_frames"]

    @property
    def _staging(self) -> Staging:
        """The episode in progress; a fresh one after every episode that was saved."""
        if self._episode is None:
            finish_journal(self.root)
            episode = Staging(self.repo_id, self.root, self._create_options, self._write_options)
            if episode.index != self.num_episodes:
                episode.drop()
                raise _another_count(self.root, episode.index, self.num_episodes)
            self._episode = episode
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
                "It is there as soon as save_episode is called again, or the dataset is opened with resume=true, and the "
                "cause is gone."
            )
        remedy = (
            "It cannot be saved any more: record it again"
            if isinstance(error, LostFramesError)
            else "Once the cause is gone, call save_episode again; a program that has ended goes on with resume=true, and "
            "records this episode again"
        )
        return (
            f"Episode {index} could not be written to {self.root}: {reason}. "
            f"The {index} episodes before it are complete. {remedy}."
        )


def _another_count(root: Path, found: int, wanted: int) -> OSError:
    return OSError(
        f"{root} holds {found} episodes where {wanted} were before: something else changed it, or its drive is gone"
    )
