"""When a dataset's episodes were recorded: LeRobot's datasets say what time passed since an episode's first frame, and no more.

The times stand in a file of their own, which LeRobot leaves alone: `{"episodes": {"0": 1754400000.25, "1": ...}}`, for each
episode when its first frame was taken, in seconds since 1970 or of another clock.
"""

import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import write_atomically

CLOCK_PATH = "meta/playbyear_clock.json"
"""Where in a dataset's folder its episodes' times stand."""

_EPISODES = "episodes"
_WANTED = f'wanted {{"{_EPISODES}": {{"0": <seconds>, "1": <seconds>}}}}'


class ClockError(InputError):
    """The times of episodes cannot be read; the message says why, and what to do."""


def note_episode_start(root: str | Path, episode_index: int, unix_time_s: float) -> None:
    """Notes when an episode's first frame was taken, on the disk itself: a process that is killed loses no other episode's.

    Args:
        root: The dataset's folder; `meta` is made if it is not there yet.
        episode_index: The episode, from 0. What was noted of it before is replaced.
        unix_time_s: Seconds since 1970, as `time.time()` gives them.

    Raises:
        ClockError: The index or the time is none, or what is there cannot be read, or is a link.
        OSError: The file cannot be written.
    """
    if isinstance(episode_index, bool) or not isinstance(episode_index, int) or episode_index < 0:
        raise ClockError(f"episode_index is {episode_index!r}; wanted a whole number from 0 on.")
    starts = {**(read_episode_starts(root) or {}), episode_index: _seconds(unix_time_s, "unix_time_s")}
    _write(Path(root) / CLOCK_PATH, starts)


def renumber_episode_starts(root: str | Path, numbers: Mapping[int, int]) -> str | None:
    """Moves the times of episodes that got other numbers, and drops those of episodes that are gone.

    Args:
        root: The folder of the dataset with the new numbers, which still has the times of the old ones.
        numbers: The new number of every episode that is still there.

    Returns:
        What is said of it; None: nothing was to be changed.

    Raises:
        OSError: The file cannot be read or written.
    """
    try:
        starts = read_episode_starts(root)
        moved = {numbers[episode]: time_s for episode, time_s in (starts or {}).items() if episode in numbers}
        if starts is None or moved == starts:
            return None
        _write(Path(root) / CLOCK_PATH, moved)
        return f"{CLOCK_PATH} has the times of {len(moved)} episodes, by their new numbers; it had {len(starts)}"
    except ClockError as error:
        return f"{CLOCK_PATH} stays as it is, by the old numbers: {error}"


def _write(path: Path, starts: Mapping[int, float]) -> None:
    for part in (path.parent, path, path.with_suffix(".partial")):
        if part.is_symlink():
            raise ClockError(f"{part} is a link; wanted one of the dataset's own. Put what it leads to in its place.")
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = {str(episode): starts[episode] for episode in sorted(starts)}
    write_atomically(path, json.dumps({_EPISODES: lines}, indent=1) + "\n")


def read_episode_starts(root: str | Path) -> dict[int, float] | None:
    """When each episode's first frame was taken [s], as far as it was noted; None: the dataset has no such file.

    Args:
        root: The dataset's folder.

    Raises:
        ClockError: The file holds something else.
        OSError: It cannot be read.
    """
    path = Path(root) / CLOCK_PATH
    return _from_json(path) if path.is_file() else None


def read_clock(path: str | Path) -> dict[int, float]:
    """The times of episodes [s] in a file of the user's.

    Args:
        path: JSON, as `CLOCK_PATH` or `{"0": 12.5}`, or a list in the order of the episodes. Any other name: a table
            (CSV) with two columns, episode and seconds, and perhaps a line of names above.

    Raises:
        ClockError: It holds something else.
        OSError: It cannot be read.
    """
    path = Path(path)
    return _from_json(path) if path.suffix.lower() == ".json" else _from_table(path)


def _from_json(path: Path) -> dict[int, float]:
    try:
        content: Any = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise ClockError(f"{path} is no JSON ({error}); {_WANTED}.") from error
    if isinstance(content, Mapping) and _EPISODES in content:
        content = content[_EPISODES]
    if isinstance(content, list):
        content = dict(enumerate(content))
    if not isinstance(content, Mapping):
        raise ClockError(f"{path} holds {type(content).__name__}; {_WANTED}.")
    return _numbered(path, list(content.items()))


def _from_table(path: Path) -> dict[int, float]:
    try:
        text = path.read_text()
        separator = next((mark for mark in "\t;" if mark in text), ",")
        table = csv.reader(text.splitlines(), delimiter=separator)
        lines = [line for line in table if any(cell.strip() for cell in line)]
    except (ValueError, csv.Error) as error:
        raise ClockError(f"{path} is no table ({error}); wanted lines such as 0,12.5.") from error
    if lines and lines[0][0].strip()[:1].isalpha():
        del lines[0]  # names
    short = [line for line in lines if len(line) < 2]
    if short:
        raise ClockError(f"{path}: a line is {','.join(short[0])!r}; wanted episode and seconds, such as 0,12.5.")
    return _numbered(path, [(line[0], line[1]) for line in lines])


def _numbered(path: Path, pairs: list[tuple[Any, Any]]) -> dict[int, float]:
    starts: dict[int, float] = {}
    for episode, seconds in pairs:
        text = str(episode).strip()
        if not text.isascii() or not text.isdigit() or len(text) > 9:
            raise ClockError(f"{path} names episode {episode!r}; wanted a whole number from 0 on. Correct it.")
        if int(text) in starts:
            raise ClockError(f"{path} names episode {int(text)} twice; wanted one time for each. Correct it.")
        starts[int(text)] = _seconds(seconds, f"{path}: the time of episode {text}")
    return starts


def _seconds(value: Any, of: str) -> float:
    try:
        if isinstance(value, bool):
            raise TypeError
        seconds = float(value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ClockError(f"{of} is {value!r}; wanted seconds. Correct it.")
    return seconds
