"""Blind baselines: scripts that know all that the camera shows and have no sense of contact.

A task is worth hearing for only as far as these fail. Each follows one strategy that needs no contact:

- `middle`: grasp in the middle of where the cube may be;
- `random`: grasp somewhere in it, each attempt elsewhere;
- `search`: grasp at one place after the other, as often as the horizon allows;
- `push`: shove the cube to the end of its range, where it must then be.

They may look at the fingers' position, as any robot may: fully closed fingers hold nothing.
"""

import numpy as np

from gym_playbyear.arena import CUBE_HALF_SIZE
from gym_playbyear.experts import GraspExpert, PickPlaceExpert, Steady

BLIND_STRATEGIES = ("middle", "random", "search", "push")
_CLOSING_STEPS = 14  # after which fingers that are not closed are taken to hold something


class BlindGrasp(GraspExpert):
    """A grasp without any sense of contact: it chooses by itself where to stop and where to close.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `BLIND_STRATEGIES`.
    """

    def __init__(self, env, strategy: str):
        self.strategy = strategy
        self.n_attempts = 0
        super().__init__(env)

    def _begin(self) -> None:
        super()._begin()
        self._n_closing = 0  # steps
        lower, upper = self.env.hidden_range
        match self.strategy:
            case "middle":
                self.guess = (lower + upper) / 2
            case "random":
                self.guess = self.rng.uniform(lower, upper)
            case "search":
                spare = self.env.variant.arm.max_opening - 2 * CUBE_HALF_SIZE
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


class SteadyBlindGrasp(Steady, BlindGrasp):
    """A grasp without any sense of contact that holds still what it lifted."""


class BlindPickPlace(BlindGrasp, PickPlaceExpert):
    """Pick and place without any sense of contact."""
