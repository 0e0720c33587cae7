"""Scripts that take things out of a bag without feeling anything: they guess how deep things lie, and where."""

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.bag_experts import TALLEST, TIP_BELOW_HAND, BagExpert

STRATEGIES = ("straight", "random", "spiral")


class BlindBag(BagExpert):
    """Goes to where it guesses that the things are, closes, and lifts what is between the fingers.

    `straight` goes down in the middle of all places, first to a greater and then to a smaller height; `random` guesses place
    and height, as the task draws them; `spiral` stays at the middle height and goes on along a spiral, from side to side.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `STRATEGIES`.
    """

    def __init__(self, env, strategy: str):
        super().__init__(env)
        self.strategy, self.n_attempts = strategy, 0
        self._guess()

    def _guess(self) -> None:
        numbers, share = self.env.variant, 0.5
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
        height = TABLE_TOP + self.env.variant.bottom[1] + TALLEST + TIP_BELOW_HAND
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
        if self._closed_for > self.config.closing:
            if self._is_empty():
                self._guess()
            else:
                self.phase = "lift"
        return None, 0.0, True

    def _lift(self):
        if self._is_empty():
            self._guess()
        return super()._lift()
