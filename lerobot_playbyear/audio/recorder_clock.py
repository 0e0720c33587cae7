"""When a dataset's episodes were recorded, and where these moments lie in a long recording of another clock.

LeRobot's datasets say what time passed since an episode's first frame, and no more. So the times stand in a file of their own,
which LeRobot leaves alone: `{"episodes": {"0": 1754400000.25, "1": ...}}`, for each episode when its first frame was taken, in
seconds since 1970 or of another clock.

No two clocks run alike. A recorder that is 100 parts in a million fast is 0.36 s ahead after an hour, seven frames at 20 Hz.
Two moments that are known on both clocks, such as a clap at the start and one at the end, say how fast it runs.
"""

import contextlib
import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import parse_json, write_atomically

CLOCK_PATH = "meta/playbyear_clock.json"
"""Where in a dataset's folder its episodes' times stand."""

_MOST_DRIFT = 0.01  # beyond it a mark is wrong, not a clock
_EPISODES = "episodes"
_WANTED = f'wanted {{"{_EPISODES}": {{"0": <seconds>, "1": <seconds>}}}}'


class ClockError(InputError):
    """The times of episodes, or the marks of two clocks, cannot be used; the message says why, and what to do."""


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


def renumber_episode_starts(root: str | Path, numbers: Mapping[int, int]) -> None:
    """Moves the times of episodes that got other numbers, and drops those of episodes that are gone.

    Times that cannot be read stay as they are.

    Args:
        root: The folder of the dataset with the new numbers, which still has the times of the old ones.
        numbers: The new number of every episode that is still there.

    Raises:
        OSError: The file cannot be read or written.
    """
    with contextlib.suppress(ClockError):
        starts = read_episode_starts(root) or {}
        moved = {numbers[episode]: time_s for episode, time_s in starts.items() if episode in numbers}
        if moved != starts:
            _write(Path(root) / CLOCK_PATH, moved)


def _write(path: Path, starts: Mapping[int, float]) -> None:
    for part in (path.parent, path):
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
            (CSV) with two columns, episode and seconds, and perhaps a line of names above, as spreadsheets of any language
            save it: with a mark of the byte order or `sep=` first, in UTF-16, with decimal commas. Or labels that Audacity
            exports, one per episode in their order: beginning, end and text of each, with tabs between them.

    Raises:
        ClockError: It holds something else.
        OSError: It cannot be read.
    """
    path = Path(path)
    return _from_json(path) if path.suffix.lower() == ".json" else _from_table(path)


def _from_json(path: Path) -> dict[int, float]:
    try:
        content: Any = parse_json(path.read_bytes())
    except ValueError as error:
        raise ClockError(f"{path} is not JSON ({error}); {_WANTED}.") from error
    if isinstance(content, Mapping) and _EPISODES in content:
        content = content[_EPISODES]
    if isinstance(content, list):
        content = dict(enumerate(content))
    if not isinstance(content, Mapping):
        raise ClockError(f"{path} holds {type(content).__name__}; {_WANTED}.")
    return _numbered(path, list(content.items()))


def _from_table(path: Path) -> dict[int, float]:
    try:
        rows = _text(path.read_bytes()).splitlines()
        said = rows.pop(0)[4:5] if rows and rows[0].lower().startswith("sep=") else ""
        separator = said or next((mark for mark in "\t;" if any(mark in row for row in rows)), ",")
        table = csv.reader(rows, delimiter=separator)
        lines = [line for line in table if any(cell.strip() for cell in line)]
    except (ValueError, csv.Error) as error:
        raise ClockError(f"{path} is not a table ({error}); wanted lines such as 0,12.5.") from error
    if lines and lines[0][0].strip()[:1].isalpha():
        del lines[0]  # names
    short = [line for line in lines if len(line) < 2 or (separator == "," and any(line[2:]))]  # 0,7,5 may be 7.5
    if short:
        raise ClockError(f"{path}: a line is {','.join(short[0])!r}; wanted episode and seconds, such as 0,12.5.")
    # Labels: no episode's number has a point.
    if separator == "\t" and all(len(line) > 2 and "." in line[0] for line in lines):
        return _numbered(path, [(episode, line[0]) for episode, line in enumerate(lines)])
    return _numbered(path, [(line[0], line[1]) for line in lines])


def _text(data: bytes) -> str:
    """Of a spreadsheet's file: UTF-8, or UTF-16 in either order, with or without its mark, or what Windows had before."""
    try:
        return data.decode(json.detect_encoding(data))
    except UnicodeDecodeError:
        return data.decode("latin-1")  # an accent in a column's name


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
        seconds = float(value.replace(",", ".") if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ClockError(f"{of} is {value!r}; wanted seconds. Correct it.")
    return seconds


def read_marks(text: str | None) -> tuple[float, float, float]:
    """How a recording's clock runs, by moments that are known on another clock as well.

    Args:
        text: `2.31=1754400000.12, 1802.74=1754401800.55`: seconds in the recording = seconds on the clock, for each mark.
            One mark says where the recording begins, two or more also how fast its clock runs. None: the clock is the
            recording's own.

    Returns:
        Seconds of the recording in a second of the clock (1.001: the recorder's clock is 0.1 % fast); when the recording
        began, on the clock [s]; and how far the worst mark lies beside that line [s].

    Raises:
        ClockError: It is written otherwise, or no two clocks differ that much.
    """
    if text is None:
        return 1.0, 0.0, 0.0
    pairs = []
    for part in text.split(","):
        try:
            sound_s, clock_s = map(float, part.split("="))
            if not math.isfinite(sound_s + clock_s):
                raise ValueError
        except ValueError as wrong:
            raise ClockError(
                f"--marks: {part.strip()!r} is not a mark; wanted seconds in the sound file = seconds on the clock, such as "
                "2.31=1754400000.12, and a comma between two of them."
            ) from wrong
        pairs.append((sound_s, clock_s))
    sound, clock = np.array(pairs).T
    origin_clock, origin_sound = float(clock.mean()), float(sound.mean())
    spread = clock - origin_clock
    if len(set(clock.tolist())) < len(clock):
        raise ClockError(f"--marks={text}: two marks have the same time on the clock; wanted different moments.")
    speed = float(spread @ (sound - origin_sound) / (spread @ spread)) if len(pairs) > 1 else 1.0
    error = float(np.abs(sound - origin_sound - speed * spread).max())
    if abs(speed - 1) > _MOST_DRIFT:
        raise ClockError(
            f"--marks={text}: {speed:.4f} seconds of sound in a second of the clock; wanted {1 - _MOST_DRIFT} to "
            f"{1 + _MOST_DRIFT}: no two clocks differ that much. Each mark is seconds in the sound file = seconds on the clock."
        )
    return speed, origin_clock - origin_sound / speed, error
