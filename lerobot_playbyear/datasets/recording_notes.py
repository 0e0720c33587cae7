"""What a robot's recording says about itself, beside the dataset: drop-outs, late ticks, when an episode began."""

import json
import logging
import os
from pathlib import Path
from typing import Any

NOTES_PATH = "meta/playbyear_recording.jsonl"
"""One line of JSON per episode, in the dataset's folder."""

_MOST_BYTES = 64 * 2**20


def note_recording(root: Path, episode: int, facts: dict[str, Any]) -> None:
    """Appends an episode's facts; they are on disk when it returns. What cannot be written is said, and costs no episode.

    Args:
        root: The dataset's folder.
        episode: Its index.
        facts: What the environment said about it.
    """
    path = root / NOTES_PATH
    try:
        with path.open("a+b") as file:
            torn = file.tell() > 0 and _last_byte(file) != b"\n"
            line = json.dumps({"episode": episode, **facts}) + "\n"
            file.write(("\n" if torn else "").encode() + line.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        logging.warning(f"{path} cannot be written ({error}): drop-outs of episode {episode} are not noted.")


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


def _last_byte(file: Any) -> bytes:
    file.seek(-1, os.SEEK_END)
    return bytes(file.read(1))
