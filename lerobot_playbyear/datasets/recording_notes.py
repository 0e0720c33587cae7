"""What a robot's recording says about itself, beside the dataset: drop-outs, late ticks, when an episode began."""

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.episode_clock import note_episode_start
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.journal import write_at_once

NOTES_PATH = "meta/playbyear_recording.jsonl"
"""One line of JSON per episode, in the dataset's folder."""

_MOST_BYTES = 64 * 2**20


def note_recording(root: Path, episode: int, facts: dict[str, Any]) -> None:
    """Appends an episode's facts, and notes when it began (`begun_at_s`, seconds since 1970), for sound of a whole session.

    They are on disk when it returns. What cannot be written is said, and costs no episode.

    Args:
        root: The dataset's folder.
        episode: Its index.
        facts: What the environment said about it.
    """
    path = root / NOTES_PATH
    try:
        if path.is_symlink() or path.parent.is_symlink():
            raise OSError("it is a link; wanted a file of the dataset's own")
        with path.open("a+b") as file:
            torn = file.tell() > 0 and _last_byte(file) != b"\n"
            line = json.dumps({"episode": episode, **facts}) + "\n"
            file.write(("\n" if torn else "").encode() + line.encode())
            file.flush()
            os.fsync(file.fileno())
        if "begun_at_s" in facts:
            note_episode_start(root, episode, facts["begun_at_s"])
    except (OSError, InputError) as error:
        logging.warning(
            f"{path.parent} cannot be written ({error}): what the robot said of episode {episode} is not noted."
        )


def recording_notes(root: Path) -> dict[int, dict[str, Any]]:
    """The facts of every episode that has some, by its index; of two the later. Lines that are none are left out."""
    path = root / NOTES_PATH
    if not path.is_file() or path.is_symlink() or path.stat().st_size > _MOST_BYTES:
        return {}
    notes: dict[int, dict[str, Any]] = {}
    for line in path.read_text(errors="replace").splitlines():
        try:
            facts = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(facts, dict) and isinstance(facts.get("episode"), int):
            notes[facts["episode"]] = facts
    return notes


def renumber_notes(root: Path, numbers: Mapping[int, int]) -> str | None:
    """Moves the facts of episodes that got other numbers, and drops those of episodes that are gone.

    Args:
        root: The folder of the dataset with the new numbers, which still has the facts of the old ones.
        numbers: The new number of every episode that is still there.

    Returns:
        What is said of it; None: nothing was to be changed.

    Raises:
        OSError: The file cannot be written.
    """
    notes = recording_notes(root)
    moved = {numbers[episode]: facts for episode, facts in notes.items() if episode in numbers}
    if list(moved) == list(notes):
        return None
    lines = [json.dumps({**moved[number], "episode": number}) + "\n" for number in sorted(moved)]
    write_at_once(root / NOTES_PATH, "".join(lines))
    return f"{NOTES_PATH} has what was noted of {len(moved)} episodes, by their new numbers; it had {len(notes)}"


def _last_byte(file: Any) -> bytes:
    file.seek(-1, os.SEEK_END)
    return bytes(file.read(1))
