"""What makes an arm hold when the loop that moves it stands still."""

import logging
import threading
import time

from lerobot_playbyear.robots.arm import Arm
from lerobot_playbyear.robots.parts import RobotError


class Watchdog:
    """Holds the arm when no action has come for too long while it is on duty.

    Args:
        arm: The arm.
        after_s: For how long [s].
    """

    def __init__(self, arm: Arm, after_s: float) -> None:
        self._arm, self._after = arm, after_s
        self._due: float | None = None
        self._wake = threading.Condition()
        self._is_over = False
        self.n_holds = 0
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def feed(self) -> None:
        """An action was sent: it is on duty."""
        with self._wake:
            self._due = time.perf_counter() + self._after
            self._wake.notify()

    def rest(self) -> None:
        """Nothing moves: it is off duty."""
        with self._wake:
            self._due = None

    def close(self) -> None:
        """Ends it."""
        with self._wake:
            self._is_over = True
            self._wake.notify()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            with self._wake:
                wait = None if self._due is None else self._due - time.perf_counter()
                if self._is_over:
                    return
                if wait is None or wait > 0:
                    self._wake.wait(wait)
                    continue
                self._due = None
            self.n_holds += 1
            try:
                self._arm.hold()
            except RobotError as error:
                logging.error(f"The loop stands still, and the robot cannot be told to hold: {error}")
