"""Scripted experts: they feel contact and know where the cube is.

The phases follow the authors' scripts (reference figures in the documentation): approach, sweep until contact, rise, hop over
the cube, descend, close, lift, and in Pick and Place carry and release. Speeds, pauses and dwell times are drawn anew for
every episode, so that neither the time since contact nor the time since the start tells what to do next: only where the hand
is when the sound comes.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.arena import CUBE_HALF_SIZE, TABLE_TOP
from gym_playbyear.arm import FINGER_THICKNESS
from gym_playbyear.base import ACTION_SCALE


@dataclass(frozen=True)
class ExpertConfig:
    """Where the expert moves and how much chance there is in it. Lengths in metres, durations in control steps.

    gain: share of the remaining distance covered per step; max_step: longest displacement per step; noise: uniform, either
    way, added to every displacement. The pairs are ranges of uniform draws, `pause_probability` is per step of the sweep.
    """

    sweep_height: float = 0.022  # of the controlled point above the table
    clear_height: float = 0.072  # fingertips above the cube
    travel_height: float = 0.12
    margin: float = 0.015  # between finger and the nearest possible cube at the start of the sweep
    gain: float = 0.5
    max_step: float = 0.02
    tolerance: float = 0.004
    noise: float = 0.0025
    contact_force: float = 0.2  # N
    squeeze_force: float = 20.0  # N, both fingers together: they hold
    sweep_step: tuple[float, float] = (0.005, 0.011)
    pause_probability: float = 0.04
    pause: tuple[int, int] = (2, 8)
    dwell: tuple[int, int] = (0, 10)
    rise_step: tuple[float, float] = (0.008, 0.018)
    hover: tuple[int, int] = (0, 8)
    descent_step: float = 0.014
    back_off: float = 0.004


CORRECTING_EXPERT = ExpertConfig(
    sweep_step=(0.008, 0.011),
    pause_probability=0.0,
    pause=(0, 1),
    dwell=(0, 1),
    rise_step=(0.013, 0.018),
    hover=(0, 1),
)
"""An expert that corrects has less time than one that demonstrates: it moves as that one does when it is quick."""


class GraspExpert:
    """Grasps the hidden cube by touch and lifts it.

    Args:
        env: The unwrapped environment, after `reset`.
        config: Distances and randomness.
    """

    def __init__(self, env, config: ExpertConfig | None = None):
        self.env = env
        self.config = config or ExpertConfig()
        self.rng: np.random.Generator = env.expert_rng
        self.phase = "approach"
        self.contact_y = np.nan  # where the hand was when it felt the cube
        self.lift_drift: np.ndarray = np.zeros(2)
        self._wait = 0
        self._begin()

    def _begin(self) -> None:
        """Draws this attempt's speeds and goes back to the start of the sweep."""
        config, rng = self.config, self.rng
        opening = self.env.variant.arm.max_opening
        self.reach = opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE  # from the hand's centre to the cube's, in contact
        self.x = float(np.mean(self.env.variant.cube_x))
        self.sweep_start, self.sweep_end = self._sweep_range()
        self.sweep_step = rng.uniform(*config.sweep_step)
        self.rise_step = rng.uniform(*config.rise_step)
        self.phase = "approach"

    def begin_at(self, phase: str) -> None:
        """Starts a new attempt in the middle: from where the hand is now, in `phase`."""
        self._begin()
        self.phase = phase
        self._wait = 0
        self.contact_y = float(self.env.eef_position[1]) + self.config.back_off

    def _sweep_range(self) -> tuple[float, float]:
        lower, upper = self.env.hidden_range
        margin = self.config.margin + self.rng.uniform(0, 0.02)
        return lower - self.reach - margin, upper - self.reach + 0.02

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        displacement, close = getattr(self, f"_{self.phase}")()
        noise = self.rng.uniform(-self.config.noise, self.config.noise, 3)
        move = (displacement + noise) / ACTION_SCALE
        return np.append(np.clip(move, -1, 1), 1.0 if close else -1.0).astype(np.float32)

    # One method per phase: it returns the displacement (3,) [m] and whether the fingers shall close.

    def _retreat(self):
        goal = np.array([*self.env.eef_position[:2], TABLE_TOP + self.config.travel_height])
        if self._near(goal, 0.02):
            self.phase = "approach"
        return self._towards(goal), False

    def _approach(self):
        goal = np.array([self.x, self.sweep_start, TABLE_TOP + self.config.travel_height])
        if self._near(goal, 0.02):
            self.phase = "lower"
        return self._towards(goal), False

    def _lower(self):
        goal = np.array([self.x, self.sweep_start, TABLE_TOP + self.config.sweep_height])
        if self._near(goal, self.config.tolerance):
            self.phase = "sweep"
            self._wait = int(self.rng.integers(*self.config.pause))
        return self._towards(goal), False

    def _sweep(self):
        eef = self.env.eef_position
        if self._feels_contact():
            self.phase = "dwell"
            self.contact_y = eef[1]
            self._wait = int(self.rng.integers(*self.config.dwell, endpoint=True))
            return self._dwell()
        if eef[1] > self.sweep_end:
            self._begin()
        if self._wait == 0 and self.rng.random() < self.config.pause_probability:
            self._wait = int(self.rng.integers(*self.config.pause, endpoint=True))
        step = 0.0
        if self._wait > 0:
            self._wait -= 1
        else:
            step = self.sweep_step
        hold = np.array([self.x, eef[1], TABLE_TOP + self.config.sweep_height])
        return self._towards(hold) + np.array([0, step, 0]), False

    def _feels_contact(self) -> bool:
        return self.env.contact_forces["gripper-cube"] > self.config.contact_force

    def _dwell(self):
        hold = np.array([self.x, self.contact_y - self.config.back_off, TABLE_TOP + self.config.sweep_height])
        if self._wait > 0:
            self._wait -= 1
        else:
            self.phase = "rise"
        return self._towards(hold), False

    def _rise(self):
        goal = np.array([self.x, self.contact_y - self.config.back_off, TABLE_TOP + self.config.clear_height])
        if self.env.eef_position[2] > goal[2] - self.config.tolerance:
            self.phase = "hover"
            self._wait = int(self.rng.integers(*self.config.hover, endpoint=True))
        return self._towards(goal, self.rise_step), False

    def _hover(self):
        goal = np.array([self.x, self.contact_y - self.config.back_off, TABLE_TOP + self.config.clear_height])
        if self._wait > 0:
            self._wait -= 1
        else:
            self.phase = "hop"
        return self._towards(goal), False

    def _hop(self):
        goal = np.array([self.x, self._grasp_y(), TABLE_TOP + self.config.clear_height])
        if self._near(goal, self.config.tolerance):
            self.phase = "descend"
        return self._towards(goal), False

    def _grasp_y(self) -> float:
        return float(self.env.cube_position[1])

    def _descend(self):
        goal = np.array([self.x, self._grasp_y(), TABLE_TOP + self.config.sweep_height])
        if abs(self.env.eef_position[2] - goal[2]) < self.config.tolerance:
            self.phase = "grasp"
        return self._towards(goal, self.config.descent_step), False

    def _grasp(self):
        opening = self.env.finger_positions.sum()
        hold = np.array([self.x, self.env.eef_position[1], TABLE_TOP + self.config.sweep_height])
        squeezed = self.env.contact_forces["gripper-cube"] > self.config.squeeze_force
        if squeezed:
            self.phase = "lift"
            self.lift_drift = self.rng.uniform(-0.25, 0.25, 2) * ACTION_SCALE * 0.3
        elif opening < CUBE_HALF_SIZE:
            self._begin()
        return self._towards(hold) * np.array([1, 0, 1]), True

    def _lift(self):
        if self._dropped():
            self._begin()
            return np.zeros(3), False
        return np.array([*self.lift_drift, self.rise_step]), True

    def _dropped(self) -> bool:
        return bool(np.linalg.norm(self.env.cube_position - self.env.eef_position) > 0.1)

    # Motion

    def _near(self, goal: np.ndarray, tolerance: float) -> bool:
        return bool(np.linalg.norm(goal - self.env.eef_position) < tolerance + self.config.noise)

    def _towards(self, goal: np.ndarray, max_step: float | None = None) -> np.ndarray:
        displacement = self.config.gain * (goal - self.env.eef_position)
        length = float(np.linalg.norm(displacement))
        limit = max_step or self.config.max_step
        return displacement * min(1.0, limit / length) if length > 0 else displacement


class PickPlaceExpert(GraspExpert):
    """Grasps the hidden cube by touch, carries it to the tray and lets go."""

    carry_height = 0.10  # m above the table
    release_height = 0.075

    def _lift(self):
        if self._dropped():
            self._begin()
            return np.zeros(3), False
        if self.env.eef_position[2] > TABLE_TOP + self.carry_height - 0.01:
            self.phase = "carry"
        return np.array([0, 0, self.rise_step]), True

    def _carry(self):
        if self._dropped():
            self._begin()
            return np.zeros(3), False
        goal = self.env.bin_position + np.array([0, 0, self.carry_height])
        if np.abs(goal - self.env.eef_position)[:2].max() < 0.006:
            self.phase = "release"
        return self._towards(goal), True

    def _release(self):
        goal = self.env.bin_position + np.array([0, 0, self.release_height])
        low = self.env.eef_position[2] < goal[2] + 0.006
        return self._towards(goal), not low
