"""Who takes things out of a bag: an expert that knows what it felt and no more.

The expert goes down slowly until a finger feels something. Which finger it was tells on which side the things lie, and where
the hand was tells how high. It goes around them, closes, lifts and holds; after an empty grasp it tries again. (One that goes
to where the things are, without having felt it, shows what nobody can learn.) Speeds, pauses and places are drawn for
every episode.
"""

from typing import Any

import numpy as np

from gym_playbyear.experts.base import Script, StagedGate
from gym_playbyear.panda import ACTION_SCALE, TIP_BELOW_HAND
from gym_playbyear.tasks.arena import TABLE_TOP
from gym_playbyear.tasks.bag import BAG, BAG_MIDDLE, CONTENTS, RIM, bottom_height, middle_of

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


class BagExpert(Script):
    """Finds what is in the bag by touch, grasps it and lifts it out.

    Args:
        env: The unwrapped environment, after `reset`.
    """

    # Lengths in metres, durations in control steps, forces in newtons; pairs are ranges of uniform draws.
    FAST, SLOW, SEARCH_STEP = (0.020, 0.030), (0.0045, 0.0065), (0.010, 0.014)  # displacement per step
    LOWERING = (0.003, 0.010)  # its limits on the way down to the bottom
    PAUSE_PROBABILITY, PAUSE = 0.04, (1, 2)  # per step of descent and search
    DWELL = (0, 1)
    NOISE = 0.001
    CONTACT_FORCE, BOTTOM_FORCE = 0.15, 0.3  # what counts as a touch of the things, and of the bag
    FIRM = 0.8  # a bag that is pressed so hard is at its bottom
    LANDED = 8.0  # on a thing that is pressed so hard the hand closes
    FURTHER = 0.010  # how far from a grasp that was empty it tries again, along x and y
    HOVER = 0.022  # how high above the last touch it goes aside
    DEEP = 0.020  # how far below a touch of the things it goes at most
    AIM = 0.004  # how far from the bag's middle it goes in
    ABOVE_BOTTOM = 0.003  # in a search
    CLOSING = 5  # for so long before it looks whether it holds something
    EMPTY = 0.004  # opening of fingers that hold nothing
    OUT = 0.055  # the hand above the rim, at the end

    def __init__(self, env):
        super().__init__(env)
        draw = self.rng.uniform
        self.fast, self.slow, self.search_step = (draw(*limits) for limits in (self.FAST, self.SLOW, self.SEARCH_STEP))
        self.entry: np.ndarray = BAG_MIDDLE + draw(-self.AIM, self.AIM, 2)
        self.turn = int(self.rng.choice(env.definition.numbers.sides))  # where it looks for the things first
        self.phase, self._closed_for = "enter", 0
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
            displacement = displacement + self.rng.uniform(-1, 1, 3) * self.NOISE
        return self._action(displacement, close)

    # One method per phase: it returns where to (3,) [m, world], or None to stay, how fast, and whether the fingers close.

    def _enter(self):
        upper = TABLE_TOP + self.env.definition.numbers.bottom[1] + TALLEST + TIP_BELOW_HAND
        if self.env.eef_position[2] < upper + 0.005:
            self.phase = "descend"
        return np.array([*self.entry, upper]), self.fast, False

    def _descend(self):
        if self._feels_contents():
            return self._touched((self._side() or self.turn) * self.env.definition.numbers.aside)
        if self._feels_bottom(self.BOTTOM_FORCE):
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
            return self._touched(ahead * self.env.definition.arm.max_opening * 0.7) if outside else self._begin_grasp()
        if self._way and abs(self._way[0] - self.env.eef_position[1]) < 0.004:
            self._way.pop(0)
        if not self._way:
            return self._begin_grasp()
        if self._pauses():
            return None, 0.0, False
        assert self._bottom is not None
        return np.array([self.entry[0], self._way[0], self._bottom + self.ABOVE_BOTTOM]), self.search_step, False

    def _touched(self, sideways: float):
        """Goes around what it felt: up, so far along y, and down again."""
        here = self.env.eef_position
        self._touched_at, self._aim = float(here[2]), here[:2] + np.array([0.0, sideways])
        self.phase, self._wait = "dwell", int(self.rng.integers(*self.DWELL, endpoint=True))
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
        height = self._touched_at + self.HOVER
        if self.env.eef_position[2] > height - 0.004:
            self.phase = "centre"
        return np.array([*self.env.eef_position[:2], height]), self.fast, False

    def _centre(self):
        goal = np.array([*self._aim, self._touched_at + self.HOVER])
        distance = float(np.linalg.norm(goal - self.env.eef_position))
        if distance < 0.004 and self._is_open():
            self.phase = "lower"
        return goal, float(np.clip(self.env.definition.numbers.share * distance, 0.004, self.fast)), False

    def _lower(self):
        height = self.env.eef_position[2]
        lowest = self._bottom if self._bottom is not None else self._touched_at - self.DEEP + 0.003
        is_at_bottom = height < self._touched_at + 0.012 and self._feels_bottom(self.FIRM)
        if is_at_bottom or height < lowest - 0.003 or self.env.contact_forces[_GRIP] > self.LANDED:
            return self._begin_grasp()
        guess = self._bottom if self._bottom is not None else self._touched_at - 0.014
        speed = np.clip(0.25 * (height - guess), *self.LOWERING)  # slower the nearer the bottom may be
        return np.array([*self._aim, TABLE_TOP]), float(speed), False

    def _begin_grasp(self):
        self.phase, self._closed_for = "grasp", 0
        return self._grasp()

    def _grasp(self):
        self._closed_for += 1
        if self._closed_for > self.CLOSING:
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
        self._aim = here[:2] + self.rng.uniform(-self.FURTHER, self.FURTHER, 2)
        self.phase = "rise"

    def _lift(self):
        if self._is_empty():
            self.try_elsewhere()
            return None, 0.0, False
        height = RIM + self.OUT
        if self.env.eef_position[2] > height - 0.005:
            self.phase = "hold"
        return np.array([*self.env.eef_position[:2], height]), self.fast, True

    def _hold(self):
        return self._lift() if self._is_empty() else (None, 0.0, True)

    # What it feels

    def _feels_contents(self) -> bool:
        return bool(self.env.contact_forces[_GRIP] > self.CONTACT_FORCE)

    def _side(self) -> int:
        """Which finger felt the things in the last step, -1 or 1; 0: both, or the hand itself, or nobody can hear which."""
        left, right = finger_forces(self.env)
        if min(left, right) > 0.3 * max(left, right) or not has_two_ears(self.env):
            return 0
        return _LEFT if left > right else _RIGHT

    def _feels_bottom(self, force: float) -> bool:
        return bool(self.env.contact_forces[_ON_BAG] > force)

    def _is_open(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.env.definition.arm.max_opening - 0.002)

    def _is_empty(self) -> bool:
        return bool(self.env.finger_positions.sum() < self.EMPTY)

    def _pauses(self) -> bool:
        if self._wait == 0 and self.rng.random() < self.PAUSE_PROBABILITY:
            self._wait = int(self.rng.integers(*self.PAUSE, endpoint=True))
        return not self._has_waited()


class TallThingsExpert(BagExpert):
    """For what is higher than a heap of keys: fingers that go to its other side pass over it."""

    HOVER, DEEP = 0.045, 0.03


SEARCH, GRASP, LIFT = range(3)
_STAGES = {
    **dict.fromkeys(("enter", "descend", "search"), SEARCH),
    **dict.fromkeys(("dwell", "rise", "centre", "lower", "grasp"), GRASP),
    **dict.fromkeys(("lift", "hold"), LIFT),
}


# Thresholds of the gate: lengths in metres, durations in control steps, forces in newtons.
PUSH_FORCE, PUSH_STEP = 12.0, 0.003  # the hand presses this hard, and would go on by at least so much
EMPTY_STEPS = 2  # for so long the fingers hold nothing
MEMORY_STEPS = 10  # how long a touch is heard
MISSED_HEIGHT = 0.07  # the hand is so far above the bag's bottom after it
SEARCH_STEPS, GRASP_STEPS = 48, 38  # left of the episode without a touch; without a grasp


class BagGate(StagedGate):
    """The gate of the bag; see `StagedGate`."""

    stages = _STAGES
    still = (18, 0.01)

    def __init__(self, env, expert: BagExpert):
        super().__init__(env, expert)
        self._empty_for, self._height_at_touch = 0, 0.0

    def _look(self) -> None:
        if self.env.contact_forces[f"gripper-{CONTENTS}"] > self.expert.CONTACT_FORCE:
            self._touched_at, self._height_at_touch = self._n_steps, float(self.env.eef_position[2])
        empty = self.env.finger_positions.sum() < self.expert.EMPTY
        self._empty_for = self._empty_for + 1 if empty else 0

    def _height(self) -> float:
        """Of the fingers' tips above the bag's bottom [m]."""
        return float(self.env.eef_position[2] - TIP_BELOW_HAND - bottom_height(self.env))

    def _holds(self) -> bool:
        closed = self.env.finger_positions.sum() < self.env.definition.arm.max_opening - 0.006
        return bool(closed and self.env.contact_forces[f"gripper-{CONTENTS}"] > 2.0 and not self._empty_for)

    def _find_reason(self, action: np.ndarray) -> str | None:
        left, forces = self.env._max_episode_steps - self._n_steps, self.env.contact_forces
        touched = None if self._touched_at is None else self._n_steps - self._touched_at
        if self._holds():
            opens = action[3] <= 0 and not self.env.gripper_blocked_steps
            return "opens" if opens else "still" if self._is_still() else None
        pressed = max(forces[f"gripper-{CONTENTS}"], forces[f"gripper-{BAG}"]) > PUSH_FORCE
        checks = {
            "pushes": pressed and action[2] * ACTION_SCALE < -PUSH_STEP,
            "empty": self._empty_for > EMPTY_STEPS,
            "missed": touched is not None and touched > 3 and self._height() > MISSED_HEIGHT,
            "still": self._is_still(),
            "late": left <= (SEARCH_STEPS if touched is None else GRASP_STEPS),
        }
        return next((reason for reason, applies in checks.items() if applies), None)

    def _take_over(self) -> None:
        """Starts the expert in the phase that fits what the hand is doing, until the stage that went wrong is done."""
        heard = self._touched_at is not None and self._n_steps - self._touched_at <= MEMORY_STEPS
        if self._holds():
            self.expert.begin_at("lift")
        elif heard:
            self.expert.begin_at("rise", self._heard_place(), self._height_at_touch)
        elif self._empty_for:
            self.expert.begin_at("rise")
            self.expert.try_elsewhere()  # where it closed is nothing
        else:
            self.expert.begin_at("enter" if self.env.eef_position[2] > RIM else "descend")
        self._hands_back_at = LIFT + 1 if self.reason == "opens" else _STAGES[self.expert.phase] + 1

    def _heard_place(self) -> np.ndarray:
        """(2,) the middle of where the things may lie on their side [m, world]: who heard a touch knows no more."""
        things = middle_of(self.env)[:2]
        return min(self.env.definition.numbers.middles, key=lambda middle: float(np.linalg.norm(middle - things)))
