"""Who takes things out of a bag: an expert that knows what it felt and no more.

The expert goes down slowly until a finger feels something. Which finger it was tells on which side the things lie, and where
the hand was tells how high. It goes around them, closes, lifts and holds; after an empty grasp it tries again. (One that goes
to where the things are, without having felt it, shows what nobody can learn.) Speeds, pauses and places are drawn anew for
every episode.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.arm import ACTION_SCALE
from gym_playbyear.bag import BAG, BAG_MIDDLE, RIM
from gym_playbyear.bag_contents import CONTENTS

TIP_BELOW_HAND = 0.0086  # m: how far the fingers' tips are below the point that is controlled
TALLEST = 0.02  # m: nothing in the bag is higher above its bottom
_GRIP, _ON_BAG = f"gripper-{CONTENTS}", f"gripper-{BAG}"
FINGERS = ("left_finger", "right_finger")
"""Parts of the arm, and the microphones on them: with both, one hears which of them touched something."""
_LEFT, _RIGHT = -1, 1  # along y


def finger_forces(env: Any) -> tuple[float, float]:
    """Largest force of the left and of the right finger on the things in the last control step [N]."""
    parts = env.definition.arm.touching
    forces = np.linalg.norm(env.hand_forces(CONTENTS), axis=2).max(axis=0)
    left, right = (float(forces[parts.index(finger)]) for finger in FINGERS)
    return left, right


def has_two_ears(env: Any) -> bool:
    """Whether each finger has a microphone, so that one can hear which of them touched."""
    return set(FINGERS) <= set(env.microphones)


@dataclass(frozen=True)
class BagExpertConfig:
    """Where the expert moves and how much chance there is in it. Lengths in metres, durations in control steps, forces in N.

    The pairs are ranges of uniform draws. fast, slow, search_step: displacement per step; lowering: its limits on the way down
    to the bottom; pause_probability: per step of descent and search; contact_force, bottom_force: what counts as a touch of
    the things, and of the bag; firm: a bag that is pressed so hard is at its bottom; landed: on a thing that is pressed so hard
    the hand closes; further: how far from a grasp that was empty it tries again, along x and y; hover: how high above the last
    touch it goes aside; deep: how far below a touch of the things it goes at most; aside: how much further than the middle of
    where they may lie it goes to the side on which it felt them; aim: how far from the bag's middle it goes in; above_bottom:
    in a search; closing: for so long before it looks whether it holds something; empty: opening of fingers that hold nothing;
    out: the hand above the rim, at the end.
    """

    fast: tuple[float, float] = (0.020, 0.030)
    slow: tuple[float, float] = (0.0045, 0.0065)
    search_step: tuple[float, float] = (0.010, 0.014)
    lowering: tuple[float, float] = (0.003, 0.010)
    pause_probability: float = 0.04
    pause: tuple[int, int] = (1, 2)
    dwell: tuple[int, int] = (0, 1)
    noise: float = 0.001
    contact_force: float = 0.15
    bottom_force: float = 0.3
    firm: float = 0.8
    landed: float = 8.0
    further: float = 0.010
    hover: float = 0.022
    deep: float = 0.020
    aside: float = -0.004
    aim: float = 0.004
    above_bottom: float = 0.003
    closing: int = 5
    empty: float = 0.004
    out: float = 0.055


FOR_TALLER_THINGS = BagExpertConfig(hover=0.045, deep=0.03)
"""For what is higher than a heap of keys: fingers that go to its other side pass over it."""


class BagExpert:
    """Finds what is in the bag by touch, grasps it and lifts it out.

    Args:
        env: The unwrapped environment, after `reset`.
        config: Distances and randomness.
    """

    def __init__(self, env, config: BagExpertConfig | None = None):
        self.env, self.config = env, config or BagExpertConfig()
        self.rng: np.random.Generator = env.expert_rng
        draw = self.rng.uniform
        self.fast, self.slow, self.search_step = (
            draw(*limits) for limits in (self.config.fast, self.config.slow, self.config.search_step)
        )
        self.entry: np.ndarray = BAG_MIDDLE + draw(-self.config.aim, self.config.aim, 2)
        self.turn = int(self.rng.choice(env.variant.sides))  # where it looks for the things first
        self.phase, self._wait, self._closed_for = "enter", 0, 0
        self._aim, self._way = self.entry, list[float]()
        self._touched_at = float(env.eef_position[2])  # height of the hand at the last touch [m, world]
        self._bottom: float | None = None  # and where it felt the bag's bottom

    def begin_at(self, phase: str, aim: np.ndarray | None = None, touched_at: float | None = None) -> None:
        """Goes on in the middle of an attempt, in a phase.

        Args:
            phase: Which one.
            aim: (2,) where the things are [m, world]; where the hand is, if None.
            touched_at: Height of the hand when it touched them [m, world]; as it is now, if None.
        """
        self.phase, self._wait, self._closed_for = phase, 0, 0
        self.entry = self.env.eef_position[:2]
        self._aim = self.entry if aim is None else aim
        self._touched_at = float(self.env.eef_position[2]) if touched_at is None else touched_at

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        goal, step, close = getattr(self, f"_{self.phase}")()
        displacement = np.zeros(3) if goal is None else goal - self.env.eef_position
        length = float(np.linalg.norm(displacement))
        if length > step:
            displacement *= step / length
        if goal is not None and self.phase != "hold":
            displacement = displacement + self.rng.uniform(-1, 1, 3) * self.config.noise
        return np.append(np.clip(displacement / ACTION_SCALE, -1, 1), 1.0 if close else -1.0).astype(np.float32)

    # One method per phase: it returns where to (3,) [m, world], or None to stay, how fast, and whether the fingers shall close.

    def _enter(self):
        upper = TABLE_TOP + self.env.variant.bottom[1] + TALLEST + TIP_BELOW_HAND
        if self.env.eef_position[2] < upper + 0.005:
            self.phase = "descend"
        return np.array([*self.entry, upper]), self.fast, False

    def _descend(self):
        if self._feels_contents():
            return self._touched((self._side() or self.turn) * (np.mean(self.env.variant.sideways) + self.config.aside))
        if self._feels_bottom(self.config.bottom_force):
            self._bottom = self._touched_at = float(self.env.eef_position[2])
            self.phase, self._way = "search", [self.turn * 0.03, -self.turn * 0.03]
            return self._search()
        if self._pauses():
            return None, 0.0, False
        return np.array([*self.entry, TABLE_TOP]), self.slow, False

    def _search(self):
        """Along the line on which the fingers open: a finger that moves so meets what lies before it."""
        ahead = np.sign(self._way[0] - self.env.eef_position[1]) if self._way else 0
        if self._feels_contents():
            outside = self._side() == ahead  # what the other finger meets lies between them
            return self._touched(ahead * self.env.variant.arm.max_opening * 0.7) if outside else self._begin_grasp()
        if self._way and abs(self._way[0] - self.env.eef_position[1]) < 0.004:
            self._way.pop(0)
        if not self._way:
            return self._begin_grasp()
        if self._pauses():
            return None, 0.0, False
        assert self._bottom is not None
        return np.array([self.entry[0], self._way[0], self._bottom + self.config.above_bottom]), self.search_step, False

    def _touched(self, sideways: float):
        """Goes around what it felt: up, so far along y, and down again."""
        here = self.env.eef_position
        self._touched_at, self._aim = float(here[2]), here[:2] + np.array([0.0, sideways])
        self.phase, self._wait = "dwell", int(self.rng.integers(*self.config.dwell, endpoint=True))
        return self._dwell()

    def _dwell(self):
        if not self._has_waited():
            return None, 0.0, False
        if np.linalg.norm(self._aim - self.env.eef_position[:2]) < 0.004:
            self.phase = "lower"
            return self._lower()
        self.phase = "rise"
        return self._rise()

    def _rise(self):
        height = self._touched_at + self.config.hover
        if self.env.eef_position[2] > height - 0.004:
            self.phase = "centre"
        return np.array([*self.env.eef_position[:2], height]), self.fast, False

    def _centre(self):
        goal = np.array([*self._aim, self._touched_at + self.config.hover])
        if np.linalg.norm(goal - self.env.eef_position) < 0.004 and self._is_open():
            self.phase = "lower"
        return goal, self.fast, False

    def _lower(self):
        height = self.env.eef_position[2]
        lowest = self._bottom if self._bottom is not None else self._touched_at - self.config.deep + 0.003
        is_low = height < self._touched_at + 0.012
        if (
            (is_low and self._feels_bottom(self.config.firm))
            or height < lowest - 0.003
            or self.env.contact_forces[_GRIP] > self.config.landed
        ):
            return self._begin_grasp()
        guess = self._bottom if self._bottom is not None else self._touched_at - 0.014
        speed = np.clip(0.25 * (height - guess), *self.config.lowering)  # slower the nearer the bottom may be
        return np.array([*self._aim, TABLE_TOP]), float(speed), False

    def _begin_grasp(self):
        self.phase, self._closed_for = "grasp", 0
        return self._grasp()

    def _grasp(self):
        self._closed_for += 1
        if self._closed_for > self.config.closing:
            if self._is_empty():
                self.try_elsewhere()
            else:
                self.phase = "lift"
        up = np.array([0.0, 0.0, 0.0008])  # less pressure on the bag, step by step
        return self.env.eef_position + up, 0.002, True

    def try_elsewhere(self) -> None:
        """Goes on with a grasp near the one that was empty."""
        here = self.env.eef_position
        self._touched_at = float(here[2])
        self._aim = here[:2] + self.rng.uniform(-self.config.further, self.config.further, 2)
        self.phase = "rise"

    def _lift(self):
        if self._is_empty():
            self.try_elsewhere()
            return None, 0.0, False
        height = RIM + self.config.out
        if self.env.eef_position[2] > height - 0.005:
            self.phase = "hold"
        return np.array([*self.env.eef_position[:2], height]), self.fast, True

    def _hold(self):
        return self._lift() if self._is_empty() else (None, 0.0, True)

    # What it feels

    def _feels_contents(self) -> bool:
        return bool(self.env.contact_forces[_GRIP] > self.config.contact_force)

    def _side(self) -> int:
        """Which finger felt the things in the last step, -1 or 1; 0: both, or the hand itself, or nobody can hear which."""
        left, right = finger_forces(self.env)
        if min(left, right) > 0.3 * max(left, right) or not has_two_ears(self.env):
            return 0
        return _LEFT if left > right else _RIGHT

    def _feels_bottom(self, force: float) -> bool:
        return bool(self.env.contact_forces[_ON_BAG] > force)

    def _is_open(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.env.variant.arm.max_opening - 0.002)

    def _is_empty(self) -> bool:
        return bool(self.env.finger_positions.sum() < self.config.empty)

    def _pauses(self) -> bool:
        if self._wait == 0 and self.rng.random() < self.config.pause_probability:
            self._wait = int(self.rng.integers(*self.config.pause, endpoint=True))
        return not self._has_waited()

    def _has_waited(self) -> bool:
        """Whether the pause is over; if not, this is one step of it."""
        if self._wait == 0:
            return True
        self._wait -= 1
        return False
