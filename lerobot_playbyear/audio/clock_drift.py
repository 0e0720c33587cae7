"""A recorder's clock and the robot's: where a moment lies in a long recording, and the recording without the drift.

No two clocks run alike. A recorder that is 100 parts in a million fast is 0.36 s ahead after an hour, seven frames at 20 Hz.
Two moments that are known on both clocks, such as a clap at the start and one at the end, say how fast it runs.
"""

import itertools
import math
import re
from dataclasses import dataclass

import numpy as np

from lerobot_playbyear.datasets.audio_files import Channels
from lerobot_playbyear.datasets.errors import InputError

_MOST_DRIFT = 0.01  # beyond it a mark is wrong, not a clock
_TAPS, _PHASES = 32, 512  # of the filter between two samples, and how many of it are computed
_KAISER_BETA = 9.0
_PIECE = 2**16  # samples at once
_MARK = re.compile(r"\s*([-+.\deE]+)\s*=\s*([-+.\deE]+)\s*")


class MarksError(InputError):
    """The marks of two clocks cannot be used; the message says why, and what to do."""


@dataclass(frozen=True)
class ClockLine:
    """Which time in a recording a time of the clock is: `sound_s = speed * (clock_s - origin_clock_s) + origin_sound_s`.

    Args:
        speed: Seconds of the recording in a second of the clock; 1.001: the recorder's clock is 0.1 % fast.
        origin_clock_s: A moment on the clock [s].
        origin_sound_s: The same moment in the recording [s].
        error_s: How far the worst mark lies beside the line [s].
    """

    speed: float = 1.0
    origin_clock_s: float = 0.0
    origin_sound_s: float = 0.0
    error_s: float = 0.0

    def sound_time(self, clock_s: float) -> float:
        """Where in the recording a moment of the clock lies [s]."""
        return self.speed * (clock_s - self.origin_clock_s) + self.origin_sound_s


def read_marks(text: str | None) -> ClockLine:
    """The line through moments that are known on both clocks.

    Args:
        text: `2.31=1754400000.12, 1802.74=1754401800.55`: seconds in the recording = seconds on the clock, for each mark.
            One mark says where the recording begins, two or more also how fast its clock runs. None: the clock is the
            recording's own.

    Raises:
        MarksError: It is written otherwise, or no two clocks differ that much.
    """
    if text is None:
        return ClockLine()
    pairs = []
    for part in text.split(","):
        match = _MARK.fullmatch(part)
        try:
            pairs.append((float(match[1]), float(match[2])) if match else (math.nan, math.nan))
        except ValueError:
            pairs.append((math.nan, math.nan))
        if not all(map(math.isfinite, pairs[-1])):
            raise MarksError(
                f"--marks: {part.strip()!r} is no mark; wanted seconds in the sound file = seconds on the clock, such as "
                "2.31=1754400000.12, and a comma between two of them."
            )
    sound, clock = np.array(pairs).T
    origin_clock, origin_sound = float(clock.mean()), float(sound.mean())
    if len(pairs) == 1:
        return ClockLine(1.0, origin_clock, origin_sound)
    spread = clock - origin_clock
    if len(set(clock.tolist())) < len(clock):
        raise MarksError(f"--marks={text}: two marks have the same time on the clock; wanted different moments.")
    speed = float(spread @ (sound - origin_sound) / (spread @ spread))
    error = float(np.abs(sound - origin_sound - speed * spread).max())
    if abs(speed - 1) > _MOST_DRIFT:
        raise MarksError(
            f"--marks={text}: {speed:.4f} seconds of sound in a second of the clock; wanted {1 - _MOST_DRIFT} to "
            f"{1 + _MOST_DRIFT}: no two clocks differ that much. Each mark is seconds in the sound file = seconds on the clock."
        )
    return ClockLine(speed, origin_clock, origin_sound, error)


class Steady:
    """A recording as a recorder without drift would have made it, computed where it is indexed.

    Args:
        sound: (n, channels) int16 PCM; sample 0 stays where it is.
        speed: How many of its samples become one: `ClockLine.speed`.
    """

    def __init__(self, sound: Channels, speed: float) -> None:
        self._sound, self._speed = sound, speed
        self.shape = (int((len(sound) - 1) / speed) + 1 if len(sound) else 0, sound.shape[1])
        self._filters = _filters()

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        if self._speed == 1 or start >= stop:
            return self._sound[start:stop]
        edges = [*range(start, stop, _PIECE), stop]
        return np.concatenate([self._piece(a, b) for a, b in itertools.pairwise(edges)])

    def _piece(self, start: int, stop: int) -> np.ndarray:
        places = np.arange(start, stop) * self._speed
        before = np.floor(places).astype(np.int64)
        phase = (places - before) * _PHASES
        lower = np.minimum(phase.astype(np.int64), _PHASES - 1)
        share = (phase - lower)[:, None].astype(np.float32)
        first, last = int(before[0]) - _TAPS // 2 + 1, int(before[-1]) + _TAPS // 2 + 1
        inside = self._sound[max(first, 0) : last].astype(np.float32)
        left = max(-first, 0)
        samples = np.pad(inside, ((left, last - first - left - len(inside)), (0, 0)))
        weights = self._filters[lower] * (1 - share) + self._filters[lower + 1] * share  # (n, taps)
        steady = np.zeros((len(places), samples.shape[1]), np.float32)
        for tap in range(_TAPS):
            steady += weights[:, [tap]] * samples[before - int(before[0]) + tap]
        return np.clip(np.round(steady), -32768, 32767).astype(np.int16)


def _filters() -> np.ndarray:
    """For each place between two samples the weights of those around it, (phases + 1, taps) float32."""
    distance = np.arange(_TAPS) - (_TAPS // 2 - 1) - np.linspace(0, 1, _PHASES + 1)[:, None]
    window = np.i0(_KAISER_BETA * np.sqrt(np.clip(1 - (distance / (_TAPS // 2)) ** 2, 0, None))) / np.i0(_KAISER_BETA)
    weights = np.sinc(distance) * window
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
