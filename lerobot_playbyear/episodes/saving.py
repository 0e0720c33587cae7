"""Saving an episode that a person may have made by hand: a full disk is a reason to ask, not to lose it."""

import contextlib
from collections.abc import Sequence
from typing import Any

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.recording_notes import note_recording
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.frames import episode_frames
from lerobot_playbyear.episodes.terminal import ask


def save_episode(episode: Episode, writer: DurableWriter) -> list[dict[str, Any]]:
    """Appends an episode to a dataset.

    Returns:
        Its frames, as the dataset holds them; none of an episode that went to the writer while it was played.

    Raises:
        DatasetWriteError: As `save_or_ask`; the dataset is as it was before.
    """
    frames = episode_frames(episode, writer.features) if episode.observations else []  # else the writer has them
    index = save_or_ask(writer, frames)
    if episode.facts is not None:
        note_recording(writer.root, index, episode.facts)
    return frames


def save_or_ask(writer: DurableWriter, frames: Sequence[dict[str, Any]] = ()) -> int:
    """Saves the episode in progress; where that fails and somebody sits at the terminal, as often as they want it.

    Args:
        writer: With an episode in progress, or none where there are `frames`.
        frames: All frames of the episode. Where pictures did not reach the disk, they are written anew; without `frames` the
            episode is lost then.

    Returns:
        The episode's index.

    Raises:
        DatasetWriteError: It could not be written, and nobody is there to make room, or they gave it up.
    """
    to_write, is_again = bool(frames), False
    while True:
        try:
            if to_write and is_again:
                _forget(writer)
            for frame in frames if to_write else ():
                writer.add_frame(frame)
            return writer.save_episode()
        except DatasetWriteError as error:
            to_write, is_again = bool(frames) and not error.can_be_repeated, True
            if not ((error.can_be_repeated or to_write) and _wants_again(error, to_write)):
                with contextlib.suppress(DatasetWriteError):
                    if to_write:  # or what got through is the beginning of the next episode
                        _forget(writer)
                raise


def _wants_again(error: DatasetWriteError, is_in_memory: bool) -> bool:
    """Asks at the terminal whether to try again; where there is none nobody wants it."""
    kept = "All of it is still in memory. " if is_in_memory else ""
    answer = ask(str(error), f"{kept}Press Enter to save it again once there is room, or type q to give it up: ")
    return answer is not None and answer.strip().lower() != "q"


def _forget(writer: DurableWriter) -> None:
    """Drops what got through of an episode in progress."""
    try:
        writer.discard_episode()
    except OSError as error:
        raise DatasetWriteError(f"Cannot write to {writer.root}: {error}.") from error
