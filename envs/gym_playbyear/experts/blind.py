"""Blind baselines: scripts that know all that the camera shows and have no sense of contact.

A task is worth hearing for only as far as these fail. Each follows one strategy that needs no contact:

- `middle`: grasp in the middle of where the cube may be;
- `random`: grasp somewhere in it, each attempt elsewhere;
- `search`: grasp at one place after the other, as often as the horizon allows;
- `push`: shove the cube to the end of its range, where it must then be.

They may look at the fingers' position, as any robot may: fully closed fingers hold nothing.
"""

import numpy as np

from gym_playbyear.experts.key_bag import TALLEST, BagExpert
from gym_playbyear.experts.occluded import GraspExpert, PickPlaceExpert
from gym_playbyear.experts.tell_apart import PouchExpert
from gym_playbyear.panda import TIP_BELOW_HAND
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE, TABLE_TOP

BLIND_GRASPS = ("middle", "random", "search", "push")
BLIND_GROPES = ("straight", "random", "spiral")
BLIND_ANSWERS = ("lift", "leave", "coin")
_CLOSING_STEPS = 14  # after which fingers that are not closed are taken to hold something


class BlindGrasp(GraspExpert):
    """A grasp without any sense of contact: it chooses by itself where to stop and where to close.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `BLIND_GRASPS`.
    """

    DWELL, HOVER = (0, 10), (0, 8)
    RISE_STEP = (0.008, 0.018)
    HOP_TOLERANCE = np.inf

    def __init__(self, env, strategy: str):
        self.strategy = strategy
        self.n_attempts = 0
        super().__init__(env)

    def _draw_habits(self) -> None:
        self.sweep_height, self.clear_height = self.SWEEP_HEIGHT, self.CLEAR_HEIGHT
        self.back_off, self.hop_step, self.hop_error = 0.004, self.MAX_STEP, 0.0

    def _begin(self) -> None:
        super()._begin()
        self._n_closing = 0  # steps
        lower, upper = self.env.shown["hidden_range"]
        match self.strategy:
            case "middle":
                self.guess = (lower + upper) / 2
            case "random":
                self.guess = self.rng.uniform(lower, upper)
            case "search":
                spare = self.env.definition.arm.max_opening - 2 * CUBE_HALF_SIZE
                n_places = max(1, int(np.ceil((upper - lower) / spare)))
                self.guess = lower + (0.5 + self.n_attempts % n_places) * (upper - lower) / n_places
            case "push":
                self.guess = upper + CUBE_HALF_SIZE
        self.n_attempts += 1
        self.phase = "approach" if self.strategy == "push" else "hop"

    def _feels_contact(self) -> bool:
        return bool(self.env.eef_position[1] + self.reach > self.guess)

    def _grasp_y(self) -> float:
        return self.guess

    def _grasp(self):
        self._n_closing += 1
        if self._fingers_met():
            self._begin()
        elif self._n_closing > _CLOSING_STEPS:
            self.phase = "lift"
        return np.zeros(3), True

    def _dropped(self) -> bool:
        return self._fingers_met()


class BlindPickPlace(BlindGrasp, PickPlaceExpert):
    """Pick and place without any sense of contact."""


class BlindBag(BagExpert):
    """Goes to where it guesses that the things are, closes, and lifts what is between the fingers.

    `straight` goes down in the middle of all places, first to a greater and then to a smaller height; `random` guesses place
    and height, as the task draws them; `spiral` stays at the middle height and goes on along a spiral, from side to side.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `BLIND_GROPES`.
    """

    def __init__(self, env, strategy: str):
        super().__init__(env)
        self.strategy, self.n_attempts = strategy, 0
        self._guess()

    def _guess(self) -> None:
        numbers, share = self.env.definition.numbers, 0.5
        low, high = numbers.bottom
        match self.strategy:
            case "straight":
                place, share = np.mean(numbers.middles, axis=0), (2 / 3, 1 / 3)[self.n_attempts % 2]
            case "random":
                place, share = numbers.draw_place(self.rng), self.rng.uniform()
            case "spiral":
                angle = 2.4 * self.n_attempts
                place = numbers.middles[self.n_attempts % len(numbers.middles)]
                place = place + numbers.around * np.sqrt(self.n_attempts / 3) * np.array([np.cos(angle), np.sin(angle)])
        height = TABLE_TOP + low + share * (high - low) + TIP_BELOW_HAND + 0.006
        self.guess = np.array([*place, height])
        self.n_attempts += 1
        self.phase = "rise"

    def _rise(self):
        height = TABLE_TOP + self.env.definition.numbers.bottom[1] + TALLEST + TIP_BELOW_HAND
        goal = np.array([*self.guess[:2], height])
        if np.linalg.norm(goal - self.env.eef_position) < 0.004 and self._is_open():
            self.phase = "lower"
        return goal, 0.02, False

    def _lower(self):
        if np.linalg.norm(self.guess - self.env.eef_position) < 0.003:
            return self._begin_grasp()
        return self.guess, 0.012, False

    def _grasp(self):
        self._closed_for += 1
        if self._closed_for > self.CLOSING:
            if self._is_empty():
                self._guess()
            else:
                self.phase = "lift"
        return None, 0.0, True

    def _lift(self):
        if self._is_empty():
            self._guess()
        return super()._lift()


class BlindPouch(PouchExpert):
    """Does as the expert, except that it cannot hear: it lifts always, leaves always, or tosses a coin.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `BLIND_ANSWERS`.
    """

    def __init__(self, env, strategy: str):
        self.strategy = strategy
        super().__init__(env)

    def wants_to_lift(self) -> bool:
        return {"lift": True, "leave": False, "coin": bool(self.rng.integers(2))}[self.strategy]
