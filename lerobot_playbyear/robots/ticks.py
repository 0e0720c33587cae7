"""The ticks of a real robot: each at its time, and an account of those that were not."""

import logging
import time
from collections.abc import Callable

_LATE_S = 0.005
_MANY = 0.05  # of an attempt's ticks: from here on it says little of who acted


class Ticks:
    """Waits for each tick of a control loop.

    A tick that comes late does not move the others, unless it is later than a whole period: then all later ones move.

    Args:
        fps: Ticks per second [Hz].
        clock, sleep: As in `time`.

    Attributes:
        n: Ticks since the start.
        n_late: How many came more than 5 ms after their time.
        lateness: How late each came [s].
    """

    def __init__(
        self,
        fps: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period, self._clock, self._sleep = 1 / fps, clock, sleep
        self.start()

    def start(self) -> float:
        """The first tick is now. Returns when that is [s]."""
        self._began = self._due = self._clock()
        self.n = self.n_late = 0
        self.lateness: list[float] = []
        self._woke = self._due
        self._paused = 0.0
        return self._due

    def go_on(self) -> float:
        """After a pause: the next tick is a period from now. Returns the time that takes the last tick's place [s]."""
        now = self._clock()
        self._paused += now - self._due
        self._due = now
        return now

    def wait(self) -> float:
        """Returns when the next tick is due, or at once if that is over: the tick's own time [s]."""
        self._due += self._period
        left = self._due - self._clock()
        if left > 0:
            self._sleep(left)
        late = max(self._clock() - self._due, 0.0)
        self._woke = self._due + late
        self.n += 1
        self.n_late += late > _LATE_S
        self.lateness.append(late)
        if late > self._period:
            self._due += late
        return self._due

    def standstill_s(self, patience_s: float) -> float:
        """How late the last tick came, or by how much more than `patience_s` has passed since it came: the longer [s]."""
        return max(self.lateness[-1], self._clock() - self._woke - patience_s)

    @property
    def rate(self) -> float:
        """Ticks per second since the start, without pauses; 0 before the first."""
        passed = self._due - self._began - self._paused
        return self.n / passed if passed > 0 else 0.0

    def facts(self) -> dict[str, float]:
        """Ticks and their rate since the start, how many were late, and by how much the worst [s]."""
        return {
            "rate_hz": round(self.rate, 3),
            "ticks": self.n,
            "late_ticks": self.n_late,
            "worst_lateness_s": round(max(self.lateness, default=0.0), 4),
        }

    def account(self, n_holds: int) -> dict[str, int]:
        """At an attempt's end: how well its time was kept; a warning where it was not.

        Args:
            n_holds: How often the arm was held meanwhile because no action came.

        Returns:
            `ticks`, `late_ticks` and `holds`, for the attempt's last `info`.
        """
        if max(self.n_late, n_holds) > _MANY * self.n > 0:
            logging.warning(
                f"{self.n_late} of {self.n} ticks came late, the worst by {1000 * max(self.lateness):.0f} ms, and the arm was "
                f"held {n_holds} times for want of an action: who acts takes longer than a tick's {1000 * self._period:.0f} "
                "ms, or the machine is too busy, and how the attempt ended says little. Take a GPU, or train with a smaller "
                "--policy.image_size, or record and train with a lower --env.fps; and let nothing else run."
            )
        return {"ticks": self.n, "late_ticks": self.n_late, "holds": n_holds}
