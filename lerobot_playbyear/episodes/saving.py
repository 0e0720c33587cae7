"""Saving an episode that a person may have made by hand: a full disk is a reason to ask, not to lose it."""

import sys
from typing import Any

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.recording_notes import note_recording
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.episodes.frames import episode_frames


def save_episode(episode: Episode, writer: DurableWriter) -> list[dict[str, Any]]:
    """Appends an episode to a dataset.

    Returns:
        Its frames, as the dataset holds them; none of an episode that went to the writer while it was played.

    Raises:
        DatasetWriteError: As `save_or_ask`; the dataset is as it was before.
    """
    frames = episode_frames(episode, writer.features) if episode.observations else []  # else the writer has them
    for frame in frames:
        writer.add_frame(frame)
    index = save_or_ask(writer)
    if episode.facts is not None:
        note_recording(writer.root, index, episode.facts)
    return frames


def save_or_ask(writer: DurableWriter) -> int:
    """Saves the episode in progress; where that fails and somebody sits at the terminal, as often as they want it.

    Args:
        writer: With an episode in progress.

    Returns:
        The episode's index.

    Raises:
        DatasetWriteError: It could not be written, and nobody is there to make room, or they gave it up.
    """
    while True:
        try:
            return writer.save_episode()
        except DatasetWriteError as error:
            if not error.can_be_repeated or sys.stdin is None or not sys.stdin.isatty():
                raise
            print(f"\n{error}", file=sys.stderr)
            try:
                answer = input("Press Enter to save it again once there is room, or type q to give it up: ")
            except EOFError:
                raise error from None
            if answer.strip().lower() == "q":
                raise
