"""Whether what LeRobot wrote of an episode is all of it; LeRobot itself logs what is missing, and goes on."""

import os
from pathlib import Path

import av
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_IMAGE_PATH

_PNG_END = b"IEND\xaeB`\x82"


class IncompleteEpisodeError(RuntimeError):
    """A camera's frames did not all reach the disk."""


class LostFramesError(IncompleteEpisodeError):
    """They are nowhere else either: the episode cannot be saved, however often it is tried."""


def check_pictures(dataset: LeRobotDataset) -> None:
    """Whether every picture of the episode in progress is on the disk, whole.

    Args:
        dataset: The staging dataset.

    Raises:
        LostFramesError: Naming the first one that is not.
        OSError: They cannot be read at the moment.
    """
    assert dataset.writer is not None
    if dataset.writer.image_writer is not None:
        dataset.writer.image_writer.wait_until_done()
    for key in set(dataset.meta.camera_keys) - set(dataset.meta.depth_keys):
        for index in range(dataset.writer.episode_buffer["size"]):
            name = DEFAULT_IMAGE_PATH.format(
                image_key=key, episode_index=dataset.meta.total_episodes, frame_index=index
            )
            if not _is_whole(dataset.root / name, dataset.root):
                raise LostFramesError(f"frame {index} of '{key}' did not reach the disk")


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
            _check_video(path, key, length)


def _check_video(path: Path, key: str, length: int) -> None:
    with av.open(str(path)) as container:
        frames = sum(1 for packet in container.demux(video=0) if packet.size)
    if frames != length:
        raise IncompleteEpisodeError(
            f"the video of '{key}' has {frames} frames where {length} were recorded: the encoder lost "
            "some, or the disk is full"
        )


def _is_whole(path: Path, folder: Path) -> bool:
    """Whether a picture has its end. Where the whole folder is gone, so is the drive, and nothing is known."""
    try:
        with path.open("rb") as file:
            if file.seek(0, os.SEEK_END) < len(_PNG_END):
                return False
            file.seek(-len(_PNG_END), os.SEEK_END)
            return file.read() == _PNG_END
    except FileNotFoundError:
        if not folder.is_dir():
            raise
        return False
