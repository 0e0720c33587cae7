"""Saving an episode that a person may have made by hand: a full disk is a reason to ask, not to lose it."""

import contextlib
import sys
from collections.abc import Sequence
from typing import Any

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.episodes.frames import episode_frames
from lerobot_playbyear.episodes.play import Episode


def save_episode(episode: Episode, writer: DurableWriter) -> list[dict[str, Any]]:
    """Appends an episode to a dataset.

    Returns:
        Its frames, as the dataset holds them.

    Raises:
        DatasetWriteError: As `save_or_ask`; the dataset is as it was before.
    """
    frames = episode_frames(episode, writer.features)
    save_or_ask(writer, frames)
    return frames


def save_or_ask(writer: DurableWriter, frames: Sequence[dict[str, Any]]) -> None:
    """Saves an episode; where that fails and somebody sits at the terminal, as often as they want it.

    Args:
        writer: Without an episode in progress.
        frames: All frames of the episode.

    Raises:
        DatasetWriteError: It could not be written, and nobody is there to make room, or they gave it up.
    """
    try:
        for frame in frames:
            writer.add_frame(frame)
        while True:
            try:
                writer.save_episode()
                return
            except DatasetWriteError as error:
                if not _wants_again(error):
                    raise
    except DatasetWriteError:
        with contextlib.suppress(DatasetWriteError):  # what got through would be the beginning of the next episode
            writer.discard_episode()
        raise


def _wants_again(error: DatasetWriteError) -> bool:
    """Asks at the terminal whether to try again; where there is none nobody wants it."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    print(f"\n{error}", file=sys.stderr)
    try:
        answer = input("Press Enter to save it again once there is room, or type q to give it up: ")
    except EOFError:
        return False
    return answer.strip().lower() != "q"
