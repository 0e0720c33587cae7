"""A dataset beside the real one, into which LeRobot writes one episode."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import datasets
import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_IMAGE_PATH
from lerobot.utils.utils import SuppressProgressBars

_PNG_END = b"IEND\xaeB`\x82"


class IncompleteEpisodeError(RuntimeError):
    """A camera's frames did not all reach the disk."""


def open_staging(
    repo_id: str, root: Path, staging: Path, create_options: dict[str, Any], write_options: dict[str, Any]
) -> tuple[LeRobotDataset, set[Path]]:
    """A dataset that continues the real one, with nothing but the metadata that LeRobot needs to do so.

    Args:
        repo_id: Its name.
        root: The real dataset's folder. Where it holds none, the staging dataset is a new one.
        staging: The staging dataset's folder, emptied.
        create_options: For `LeRobotDataset.create`, besides `write_options`.
        write_options: For `LeRobotDataset.create` and `LeRobotDataset.resume`.

    Returns:
        The dataset, and the files that were put there for it to continue from, relative to `staging`.
    """
    shutil.rmtree(staging, ignore_errors=True)
    if not (root / "meta" / "info.json").is_file():
        return LeRobotDataset.create(repo_id, root=staging, **create_options, **write_options), set()
    (staging / "meta").mkdir(parents=True)
    for name in ("info.json", "stats.json", "tasks.parquet"):
        if (root / "meta" / name).exists():
            shutil.copyfile(root / "meta" / name, staging / "meta" / name)
    before: set[Path] = set()
    for path in sorted(root.glob("meta/episodes/*/*.parquet"))[-1:]:
        table = path.relative_to(root)
        _copy_last_episode(path, staging / table)
        before.add(table)
    with _datasets_cache_in(staging / ".cache"), SuppressProgressBars():
        return LeRobotDataset.resume(repo_id, root=staging, **write_options), before


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
