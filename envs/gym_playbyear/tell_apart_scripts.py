"""Scripts for the pouch: the expert, which knows what is in it, and those that decide without hearing.

Heights, speeds, pauses and the time of listening are drawn anew for every attempt, so that time tells nothing. The second lift
goes higher than the first, and a hand that leaves the pouch goes where it never was before: a policy with a memory of
two seconds sees in what part of the task it is.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.arm import ACTION_SCALE

BLIND_STRATEGIES = ("lift", "leave", "coin")


@dataclass(frozen=True)
class PouchConfig:
    """Where the scripts move, and how much chance there is in it. Lengths in metres, durations in control steps.

    gain: share of the remaining distance covered per step; noise: uniform, either way, added to every displacement; holding:
    fingers that are closed for `closing` steps and further apart than this hold something. The pairs are ranges of uniform
    draws; heights are of the controlled point above the table, `rest` is where a hand goes that leaves the pouch.
    """

    grasp_height: float = 0.024
    tolerance: float = 0.005
    gain: float = 0.6
    noise: float = 0.003
    closing: int = 3
    holding: float = 0.025
    step: tuple[float, float] = (0.025, 0.045)
    hover_height: tuple[float, float] = (0.10, 0.13)
    probe_height: tuple[float, float] = (0.12, 0.16)
    keep_height: tuple[float, float] = (0.18, 0.22)
    pause: tuple[int, int] = (0, 4)
    listen: tuple[int, int] = (2, 6)
    rest: tuple[tuple[float, float], ...] = ((-0.12, -0.02), (0.20, 0.28), (0.92, 1.0))


class PouchExpert:
    """Lifts the pouch, drops it and waits; then lifts it again or leaves it.

    Args:
        env: The unwrapped environment, after `reset`.
        config: Distances and randomness.
    """

    def __init__(self, env, config: PouchConfig | None = None):
        self.env = env
        self.config = config or PouchConfig()
        self.rng: np.random.Generator = env.expert_rng
        self.was_dropped = False
        self._begin()

    def _begin(self) -> None:
        """Draws speed and heights for the next grasp."""
        self.step = self.rng.uniform(*self.config.step)
        self.hover_height = self.rng.uniform(*self.config.hover_height)
        self.lift_height = self.rng.uniform(
            *(self.config.keep_height if self.was_dropped else self.config.probe_height)
        )
        self.phase = "approach"
        self._wait = 0

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        displacement, close = getattr(self, f"_{self.phase}")()
        still = self.phase in ("keep", "rest")
        noise = np.zeros(3) if still else self.rng.uniform(-self.config.noise, self.config.noise, 3)
        move = (displacement + noise) / ACTION_SCALE
        return np.append(np.clip(move, -1, 1), 1.0 if close else -1.0).astype(np.float32)

    def wants_to_lift(self) -> bool:
        """Whether to lift the pouch again; asked once, when it was dropped and listened to."""
        return self.env.contents == "screws"

    # One method per phase: it returns the displacement (3,) [m] and whether the fingers shall close.

    def _approach(self):
        goal = self._over_pouch(self.hover_height)
        if self._near(goal, 2 * self.config.tolerance) and self.env.gripper_obeys:
            self.phase = "lower"
        return self._towards(goal), False

    def _lower(self):
        goal = self._over_pouch(self.config.grasp_height)
        if self._near(goal, self.config.tolerance):
            self.phase, self._wait = "grasp", self.config.closing
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
        if way < self.config.tolerance:
            self.phase = "keep" if self.was_dropped else "carry"
            self._wait = int(self.rng.integers(*self.config.pause, endpoint=True))
        return np.array([0, 0, min(self.step, max(0.0, way))]), True

    def _carry(self):
        """Up there, until the fingers obey again, and a little longer."""
        if self.env.gripper_obeys and self._has_waited():
            self.phase = "drop"
            return np.zeros(3), False
        return np.zeros(3), True

    def _drop(self):
        """Until the pouch lies, and then for as long as it takes to listen."""
        self.was_dropped = True
        self.phase, self._wait = "listen", int(self.rng.integers(*self.config.listen, endpoint=True))
        return np.zeros(3), False

    def _listen(self):
        if self._has_waited():
            self._begin()
            if not self.wants_to_lift():
                self.phase = "leave"
                self.rest = np.array([self.rng.uniform(*limits) for limits in self.config.rest])
        return np.zeros(3), False

    def _leave(self):
        if self._near(self.rest, 2 * self.config.tolerance):
            self.phase = "rest"
        return self._towards(self.rest), False

    def _rest(self):
        return np.zeros(3), False

    def _keep(self):
        return np.zeros(3), True

    # Motion

    def _holds(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.config.holding)

    def _has_waited(self) -> bool:
        """Whether the pause is over; if not, this is one step of it."""
        if self._wait == 0:
            return True
        self._wait -= 1
        return False

    def _over_pouch(self, height: float) -> np.ndarray:
        """A point above the pouch, so high above the table (3,) [m, world frame]."""
        return np.array([*self.env.pouch_position[:2], TABLE_TOP + height])

    def _near(self, goal: np.ndarray, tolerance: float) -> bool:
        return bool(np.linalg.norm(goal - self.env.eef_position) < tolerance + self.config.noise)

    def _towards(self, goal: np.ndarray) -> np.ndarray:
        displacement = self.config.gain * (goal - self.env.eef_position)
        length = float(np.linalg.norm(displacement))
        return displacement * min(1.0, self.step / length) if length > 0 else displacement


class BlindPouch(PouchExpert):
    """Does as the expert, except that it cannot hear: it lifts always, leaves always, or tosses a coin.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `BLIND_STRATEGIES`.
    """

    def __init__(self, env, strategy: str):
        self.strategy = strategy
        super().__init__(env)

    def wants_to_lift(self) -> bool:
        return {"lift": True, "leave": False, "coin": bool(self.rng.integers(2))}[self.strategy]
