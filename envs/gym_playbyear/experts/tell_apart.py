"""Scripts for the pouch: the expert, which knows what is in it, which knows what is in it.

Heights, speeds, pauses and the time of listening are drawn for every attempt, so that time tells nothing. The second lift
goes higher than the first, and a hand that leaves the pouch goes where it never was before: a policy with a memory of
two seconds sees in what part of the task it is.
"""

import numpy as np

from gym_playbyear.experts.base import Script
from gym_playbyear.tasks.arena import TABLE_TOP


class PouchExpert(Script):
    """Lifts the pouch, drops it and waits; then lifts it again or leaves it.

    Args:
        env: The unwrapped environment, after `reset`.
    """

    # Lengths in metres, durations in control steps; pairs are ranges of uniform draws.
    GRASP_HEIGHT, TOLERANCE = 0.024, 0.005  # heights are of the controlled point above the table
    GAIN = 0.6  # share of the remaining distance covered per step
    NOISE = 0.003  # uniform, either way, added to every displacement
    CLOSING, HOLDING = 3, 0.025  # fingers that are closed for so long and further apart than this hold something
    STEP = (0.025, 0.045)
    HOVER_HEIGHT, PROBE_HEIGHT, KEEP_HEIGHT = (0.10, 0.13), (0.12, 0.16), (0.18, 0.22)
    PAUSE, LISTEN = (0, 4), (2, 6)
    REST = ((-0.12, -0.02), (0.20, 0.28), (0.92, 1.0))  # where a hand goes that leaves the pouch

    def __init__(self, env):
        super().__init__(env)
        self.was_dropped = False
        self._begin()

    def _begin(self) -> None:
        """Draws speed and heights for the next grasp."""
        self.step = self.rng.uniform(*self.STEP)
        self.hover_height = self.rng.uniform(*self.HOVER_HEIGHT)
        self.lift_height = self.rng.uniform(*(self.KEEP_HEIGHT if self.was_dropped else self.PROBE_HEIGHT))
        self.phase = "approach"
        self._wait = 0

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        displacement, close = getattr(self, f"_{self.phase}")()
        still = self.phase in ("keep", "rest")
        return self._action(displacement + (np.zeros(3) if still else self._noise()), close)

    def wants_to_lift(self) -> bool:
        """Whether to lift the pouch again; asked once, when it was dropped and listened to."""
        return self.env.secrets["contents"] == "screws"

    # One method per phase: it returns the displacement (3,) [m] and whether the fingers close.

    def _approach(self):
        goal = self._over_pouch(self.hover_height)
        if self._near(goal, 2 * self.TOLERANCE) and not self.env.gripper_blocked_steps:
            self.phase = "lower"
        return self._towards(goal), False

    def _lower(self):
        goal = self._over_pouch(self.GRASP_HEIGHT)
        if self._near(goal, self.TOLERANCE):
            self.phase, self._wait = "grasp", self.CLOSING
            return np.zeros(3), True
        return self._towards(goal), False

    def _grasp(self):
        if self._has_waited():
            if not self._holds():
                self._begin()  # the fingers met
                return np.zeros(3), False
            self.phase = "lift"
        return np.zeros(3), True

    def _lift(self):
        way = TABLE_TOP + self.lift_height - self.env.eef_position[2]
        if way < self.TOLERANCE:
            self.phase = "keep" if self.was_dropped else "carry"
            self._wait = int(self.rng.integers(*self.PAUSE, endpoint=True))
        return np.array([0, 0, min(self.step, max(0.0, way))]), True

    def _carry(self):
        """Up there, until the fingers obey again, and a little longer."""
        if not self.env.gripper_blocked_steps and self._has_waited():
            self.phase = "drop"
            return np.zeros(3), False
        return np.zeros(3), True

    def _drop(self):
        """Until the pouch lies, and then for as long as it takes to listen."""
        self.was_dropped = True
        self.phase, self._wait = "listen", int(self.rng.integers(*self.LISTEN, endpoint=True))
        return np.zeros(3), False

    def _listen(self):
        if self._has_waited():
            self._begin()
            if not self.wants_to_lift():
                self.phase = "leave"
                self.rest = np.array([self.rng.uniform(*limits) for limits in self.REST])
        return np.zeros(3), False

    def _leave(self):
        if self._near(self.rest, 2 * self.TOLERANCE):
            self.phase = "rest"
        return self._towards(self.rest), False

    def _rest(self):
        return np.zeros(3), False

    def _keep(self):
        return np.zeros(3), True

    # Motion

    def _holds(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.HOLDING)

    def _over_pouch(self, height: float) -> np.ndarray:
        """A point above the pouch, so high above the table (3,) [m, world frame]."""
        return np.array([*self.env.position("pouch")[:2], TABLE_TOP + height])

    def _towards(self, goal: np.ndarray) -> np.ndarray:
        return self._step_towards(goal, self.step)
