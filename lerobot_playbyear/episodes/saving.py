"""Saving an episode that a person may have made by hand: a full disk is a reason to ask, not to lose it."""

import contextlib
import logging
import shutil
from collections.abc import Sequence
from typing import Any

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.recording_notes import note_recording
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.frames import episode_frames
from lerobot_playbyear.episodes.terminal import ask

_FIRST_BYTES = 256 * 2**20  # that an episode is taken to need while nothing is known of it
_BESIDE_BYTES = 16 * 2**20  # besides an episode: small files of the dataset are written anew with it


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


def check_room(writer: DurableWriter, episode_bytes: int | None) -> None:
    """Before an episode that cannot be had again: whether the disk has room for it; else the person at the terminal is asked.

    Args:
        writer: Of the dataset.
        episode_bytes: What an episode takes while it is recorded; saving it takes as much again. None: nothing is known yet,
            and so nobody is kept from beginning but by their own answer.

    Raises:
        DatasetWriteError: There is no room, and nobody is there to make some, or they end the recording.
    """
    is_known = episode_bytes is not None
    wanted = _FIRST_BYTES if episode_bytes is None else 2 * episode_bytes + _BESIDE_BYTES
    while (free := shutil.disk_usage(writer.root).free) < wanted:
        why = (
            f"twice what one took here, and {_BESIDE_BYTES >> 20}" if is_known else "a guess, as none was recorded yet"
        )
        problem = (
            f"The disk of {writer.root} has {free >> 20} MiB left; wanted {wanted >> 20} MiB for the next episode ({why}), "
            f"which would be lost on a full disk. The {writer.num_episodes} episodes before it are complete."
        )
        answer = ask(problem, "Press Enter to look again once there is room, b to begin all the same, or q to end: ")
        if answer is None and not is_known:
            logging.warning(f"{problem} Make room.")
        elif answer is None or answer.strip().lower() == "q":
            raise DatasetWriteError(f"{problem} Make room, and go on with --resume=true.")
        if answer is None or answer.strip().lower() == "b":
            return


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
