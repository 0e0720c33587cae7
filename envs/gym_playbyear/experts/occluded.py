"""Scripted experts: they feel contact and know where the cube is.

The phases follow the authors' scripts (reference figures in the documentation): approach, sweep until contact, rise, hop over
the cube, descend, close, lift, and in Pick and Place carry and release. Speeds, pauses and dwell times are drawn for
every episode, so that neither the time since contact nor the time since the start tells what to do next: only where the hand
is when the sound comes.
"""

import numpy as np

from gym_playbyear.experts.base import Script
from gym_playbyear.panda import ACTION_SCALE, FINGER_THICKNESS
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE, LINE_X, TABLE_TOP


class GraspExpert(Script):
    """Grasps the hidden cube by touch, lifts it and holds it still.

    The hand comes down where it is above the cube and not on the way there, and it shows that only the touch tells where that
    is: how far it draws back before it rises differs from search to search, and a hop first misses the cube, either way, and is
    mended. Four of five hops end within 18 steps of the touch, while a policy of twenty frames remembers where it was.

    Args:
        env: The unwrapped environment, after `reset`.
    """

    # Lengths in metres, durations in control steps; pairs are ranges of uniform draws.
    SWEEP_HEIGHT = 0.022  # of the controlled point above the table
    CLEAR_HEIGHT = 0.072  # fingertips above the cube
    HIGHER = (0.0, 0.012)  # by which sweeps, and hops, are higher than that
    TRAVEL_HEIGHT = 0.12
    MARGIN = 0.015  # between finger and the nearest possible cube at the start of the sweep
    MAX_STEP = 0.02
    TOLERANCE = 0.004
    CONTACT_FORCE = 0.2  # N
    SQUEEZE_FORCE = 20.0  # N, both fingers together: they hold
    SWEEP_STEP = (0.005, 0.008)
    PAUSE_PROBABILITY, PAUSE = 0.04, (2, 8)  # per step of the sweep
    DWELL = (0, 2)
    RISE_STEP = (0.013, 0.018)
    HOVER = (0, 1)
    HOP_TOLERANCE = 0.002  # how exactly the hand is above the cube, along the sweep, before it comes down
    HOP_STEP = (0.015, 0.022)
    HOP_ERROR = (-0.012, 0.012)  # by which a hop misses the cube, along the sweep, before it is mended
    DESCENT_STEP = 0.014
    BACK_OFF = (0.002, 0.014)  # how far it draws back from a touch
    BRING_BACK_STEP = 0.04  # with which a correction carries the cube back, to show the way to the tray again
    HOLD_HEIGHT = 0.085  # above the table, where it holds still

    def __init__(self, env):
        super().__init__(env)
        self.contact_y = np.nan  # where the hand was when it felt the cube
        self.lift_drift: np.ndarray = np.zeros(2)
        self._begin()

    def _begin(self) -> None:
        """Draws this attempt's speeds and goes back to the start of the sweep."""
        rng = self.rng
        opening = self.env.definition.arm.max_opening
        self.reach = opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE  # from the hand's centre to the cube's, in contact
        lower, upper = self.env.shown["hidden_range"]
        self.sweep_start = lower - self.reach - (self.MARGIN + rng.uniform(0, 0.02))
        self.sweep_end = upper - self.reach + 0.02
        self.sweep_step = rng.uniform(*self.SWEEP_STEP)
        self.rise_step = rng.uniform(*self.RISE_STEP)
        self._draw_habits()
        self.phase = "approach"

    def _draw_habits(self) -> None:
        """What differs between searches, so that only the touch tells where the cube is."""
        higher = self.rng.uniform(*self.HIGHER, 2)
        self.sweep_height, self.clear_height = np.array([self.SWEEP_HEIGHT, self.CLEAR_HEIGHT]) + higher
        self.back_off = self.rng.uniform(*self.BACK_OFF)
        self.hop_step = self.rng.uniform(*self.HOP_STEP)
        self.hop_error = self.rng.uniform(*self.HOP_ERROR)

    def begin_at(self, phase: str) -> None:
        """Starts a new attempt in the middle: from where the hand is now, in `phase`."""
        self._begin()
        self.phase = phase
        self._wait = 0
        self.contact_y = float(self.env.eef_position[1]) + self.back_off

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        if self.phase in ("lift", "hold", "bring_back", "carry") and self._dropped():
            self._begin()
            displacement, close = np.zeros(3), False
        else:
            displacement, close = getattr(self, f"_{self.phase}")()
        return self._action(displacement + self._noise(), close)

    def _noise(self) -> np.ndarray:
        return np.zeros(3) if self.phase == "hold" else super()._noise()

    # One method per phase: it returns the displacement (3,) [m] and whether the fingers close.

    def _retreat(self):
        goal = np.array([*self.env.eef_position[:2], TABLE_TOP + self.TRAVEL_HEIGHT])
        return self._go(goal, 0.02, "approach")

    def _approach(self):
        return self._go(self._on_line(self.sweep_start, self.TRAVEL_HEIGHT), 0.02, "lower")

    def _lower(self):
        goal = self._on_line(self.sweep_start, self.sweep_height)
        if self._near(goal, self.TOLERANCE):
            self._wait = int(self.rng.integers(*self.PAUSE))
        return self._go(goal, self.TOLERANCE, "sweep")

    def _sweep(self):
        eef = self.env.eef_position
        if self._feels_contact():
            self.phase = "dwell"
            self.contact_y = eef[1]
            self._wait = int(self.rng.integers(*self.DWELL, endpoint=True))
            return self._dwell()
        if eef[1] > self.sweep_end:
            self._begin()
        if self._wait == 0 and self.rng.random() < self.PAUSE_PROBABILITY:
            self._wait = int(self.rng.integers(*self.PAUSE, endpoint=True))
        step = self.sweep_step if self._has_waited() else 0.0
        return self._towards(self._on_line(eef[1], self.sweep_height)) + np.array([0, step, 0]), False

    def _feels_contact(self) -> bool:
        return self.env.contact_forces["gripper-cube"] > self.CONTACT_FORCE

    def _dwell(self):
        if self._has_waited():
            self.phase = "rise"
        return self._towards(self._on_line(self.contact_y - self.back_off, self.sweep_height)), False

    def _rise(self):
        goal = self._on_line(self.contact_y - self.back_off, self.clear_height)
        if self.env.eef_position[2] > goal[2] - self.TOLERANCE:
            self.phase = "hover"
            self._wait = int(self.rng.integers(*self.HOVER, endpoint=True))
        return self._towards(goal, self.rise_step), False

    def _hover(self):
        if self._has_waited():
            self.phase = "hop"
        return self._towards(self._on_line(self.contact_y - self.back_off, self.clear_height)), False

    def _hop(self):
        goal = self._on_line(self._grasp_y() + self.hop_error, self.clear_height)
        if self.hop_error and abs(goal[1] - self.env.eef_position[1]) < self.TOLERANCE:
            self.hop_error, goal = 0.0, self._on_line(self._grasp_y(), self.clear_height)
        if abs(goal[1] - self.env.eef_position[1]) < self.HOP_TOLERANCE:
            return self._go(goal, self.TOLERANCE, "descend")
        return self._towards(goal, self.hop_step), False

    def _grasp_y(self) -> float:
        return float(self.env.position("cube")[1])

    def _descend(self):
        goal = self._on_line(self._grasp_y(), self.SWEEP_HEIGHT)
        if abs(self.env.eef_position[2] - goal[2]) < self.TOLERANCE:
            self.phase = "grasp"
        return self._towards(goal, self.DESCENT_STEP), False

    def _grasp(self):
        hold = self._on_line(self.env.eef_position[1], self.SWEEP_HEIGHT)
        if self.env.contact_forces["gripper-cube"] > self.SQUEEZE_FORCE:
            self.phase = "lift"
            self.lift_drift = self.rng.uniform(-0.25, 0.25, 2) * ACTION_SCALE * 0.3
        elif self._fingers_met():
            self._begin()
        return self._towards(hold) * np.array([1, 0, 1]), True

    def _fingers_met(self) -> bool:
        """Whether they hold nothing."""
        return bool(self.env.finger_positions.sum() < CUBE_HALF_SIZE)

    def _lift(self):
        if self.env.eef_position[2] > TABLE_TOP + self.HOLD_HEIGHT:
            self.phase = "hold"
        return np.array([*self.lift_drift, self.rise_step]), True

    def _hold(self):
        return np.zeros(3), True

    def _dropped(self) -> bool:
        return bool(np.linalg.norm(self.env.position("cube") - self.env.eef_position) > 0.1)

    # Motion

    def _go(self, goal: np.ndarray, tolerance: float, next_phase: str) -> tuple[np.ndarray, bool]:
        """With open fingers to a point (3,) [m, world frame]; that near to it, the next phase begins."""
        if self._near(goal, tolerance):
            self.phase = next_phase
        return self._towards(goal), False

    def _on_line(self, y: float, height: float) -> np.ndarray:
        """A point on the line of the sweep, so high above the table (3,) [m, world frame]."""
        return np.array([LINE_X, y, TABLE_TOP + height])

    def _towards(self, goal: np.ndarray, max_step: float | None = None) -> np.ndarray:
        return self._step_towards(goal, max_step or self.MAX_STEP)


class PickPlaceExpert(GraspExpert):
    """Grasps the hidden cube by touch, carries it to the tray and lets go.

    It carries level, at a height and for a time that are drawn for each attempt: if the hand sank on the way, or always came
    as long after the fingers closed, that would tell a policy when to let go, and not the place. It comes down when the fingers
    obey again: in what a policy sees, a wait above the tray is like a pause of the sweep.
    """

    CARRY_HEIGHT = (0.103, 0.128)  # m above the table
    CARRY_SLACK = (-2, 20)  # steps from when the fingers obey until it is above the tray, at least; then it comes down
    RELEASE_HEIGHT = 0.075  # m above the table
    carry_height, carry_step = CARRY_HEIGHT[0], 0.0

    def _draw_habits(self) -> None:
        super()._draw_habits()
        self.carry_height, self.carry_step = self.rng.uniform(*self.CARRY_HEIGHT), 0.0

    def _lift(self):
        if self.env.eef_position[2] > TABLE_TOP + self.carry_height - 0.005:
            self.phase = "carry"
        return np.array([0, 0, self.rise_step]), True

    def bring_back(self, y: float) -> None:
        """The cube that it holds, to that place on the line of the sweep [m, world frame], and from there to the tray."""
        self.phase, self._lifted_y = "bring_back", y

    def _bring_back(self):
        goal = self._on_line(self._lifted_y, self.carry_height)
        if self._near(goal, 0.02):
            self.phase = "carry"
        return self._towards(goal, self.BRING_BACK_STEP), True

    def _carry(self):
        rest = self.env.shown["bin_position"] + np.array([0, 0, self.carry_height]) - self.env.eef_position
        if np.abs(rest)[:2].max() < 0.006:
            self.phase = "release"
        n_steps = max(self.env.gripper_blocked_steps + self.rng.uniform(*self.CARRY_SLACK), 1)
        self.carry_step = self.carry_step or min(float(np.hypot(*rest[:2])) / n_steps, self.MAX_STEP)
        level = self._towards(self.env.eef_position + rest * [1, 1, 0], self.carry_step)
        return level + np.array([0, 0, np.clip(self.GAIN * rest[2], -0.015, 0.015)]), True

    def _release(self):
        goal = self.env.shown["bin_position"] + np.array([0, 0, self.RELEASE_HEIGHT])
        return self._towards(goal), self.env.eef_position[2] > goal[2] + 0.006
