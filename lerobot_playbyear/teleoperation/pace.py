"""Keeps a person's time: as many control steps per second as the robot makes, and no more."""

import time
from collections import deque
from collections.abc import Callable

_WINDOW_S = 1.0  # over which the rate is measured


class Pace:
    """Waits for each step's turn.

    A step that comes late moves all later ones: a person cannot use steps that are rushed through to catch up.

    Args:
        fps: Steps per second.
        clock, sleep: As in `time`.
    """

    def __init__(
        self,
        fps: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.fps = fps
        self._clock, self._sleep = clock, sleep
        self._due: float | None = None
        self._times: deque[float] = deque()

    def start(self) -> None:
        """The next step is due at once; what was measured is forgotten."""
        self._due = None
        self._times.clear()

    def wait(self) -> None:
        """Returns when the next step is due."""
        now = self._clock()
        if self._due is None or now > self._due:
            self._due = now
        else:
            self._sleep(self._due - now)
        self._due += 1 / self.fps
        self._times.append(self._clock())
        while self._times[-1] - self._times[0] > _WINDOW_S and len(self._times) > 2:
            self._times.popleft()

    @property
    def achieved_fps(self) -> float:
        """Steps per second of late; 0 for the first half second, in which that is not known."""
        if len(self._times) < 2 or self._times[-1] - self._times[0] < _WINDOW_S / 2:
            return 0.0
        return (len(self._times) - 1) / (self._times[-1] - self._times[0])
