"""Tapping: a hand that is lowered stops higher where it lands on the cube than beside it, and the arm's own position says so.

A script keeps a belief about the cube's place, taps where a tap tells most, and closes where the cube should be between the
fingers. If it holds nothing it goes on, as long as the attempt lasts.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from gym_playbyear.adversaries.belief import CubeBelief
from gym_playbyear.adversaries.script import GRASP_HEIGHT, TIP_BELOW_HAND, Actions, DeafScript, Verdict
from gym_playbyear.adversaries.view import TaskFacts
from gym_playbyear.arena import CUBE_HALF_SIZE
from gym_playbyear.arm import ACTION_SCALE

_TOP = 2 * CUBE_HALF_SIZE + TIP_BELOW_HAND  # m: the hand's height above the table when the tips rest on the cube
_SLOW, _SURE_LAG = 0.002, 0.0007  # m: a hand that is lowered this slowly stops where the lag is that large
_GRASP_STEPS = 22  # from a tap to a lifted cube, and one tap more
_SPACING = 0.002  # m: between the places that are considered for a tap


@dataclass(frozen=True)
class Tap:
    """How to tap. Lengths in metres.

    Attributes:
        closed: With closed fingers, which tell left from right, and cost a change of the gripper.
        step: How far the hand is lowered per control step.
        depth: How far below the cube's top the hand is sent; it stops there if nothing is in its way.
        clear: How far above the cube's top the hand travels.
        lag: The hand is this much higher than it was sent: blocked.
        averaged: Measurements whose mean has to say so; if they are many, what it is in the air is measured as well.
        aside: How far beside the line the hand taps, so that its fingers meet the cube's rim alone.
        scan: From one end of the range to the other in steps of this length; None: where a tap tells most.
        sure: The script closes the fingers where the cube is between them with this probability.
    """

    closed: bool = False
    step: float = ACTION_SCALE
    depth: float = 0.010
    clear: float = 0.008
    lag: float = 0.0007
    averaged: int = 1
    aside: float = 0.0
    scan: float | None = None
    sure: float = 0.5


TAPS = {
    "tap_fast": Tap(),
    "tap_gentle": Tap(step=0.001, depth=0.004, clear=0.003, lag=0.0005, averaged=2),
    "tap_feather": Tap(step=0.004, depth=0.0012, clear=0.002, lag=0.00008, averaged=14),
    "tap_closed": Tap(closed=True),
    "tap_along": Tap(scan=0.012),
    "tap_across": Tap(aside=0.022),
}


class TappingScript(DeafScript):
    """Taps, narrows down where the cube is, grasps.

    Args:
        facts, rng: As of every script.
        tap: How to tap.
    """

    def __init__(self, facts: TaskFacts, rng: np.random.Generator, tap: Tap):
        self.tap = tap
        super().__init__(facts, rng)

    def _plan(self) -> Actions:
        self.belief = CubeBelief(*self.hidden_range)
        self._scanned = self.hidden_range[0] - self.reach
        if self.tap.closed:
            yield from self._set_grip(True)
        while True:
            if self._closes and self._is_narrow():
                yield from self._set_grip(False)
            place = self._choose()
            blocked = yield from self._tap(place)
            self.belief.update(place, self.opening, blocked)
            if blocked:
                self._scanned = np.inf
            sure = self.belief.between(place, self.opening) > (0 if self._is_late() else self.tap.sure)
            if not blocked and not self._closes and sure:
                yield from self._try(place)
            else:
                yield from self._rise(_TOP + self.tap.clear)

    def _is_narrow(self) -> bool:
        """Whether a grasp is worth an attempt, or taps with these fingers tell no more."""
        hands = self._places()
        return bool(
            self.belief.between(hands, self.facts.max_opening).max() > self.tap.sure
            or self.belief.information(hands, self.opening).max() < 0.2
        )

    def _places(self) -> np.ndarray:
        """Where a tap is considered (N,) [m]."""
        lower, upper = self.hidden_range
        return np.arange(lower - self.reach, upper + self.reach, _SPACING)

    def _choose(self) -> float:
        """Where to tap next [m]."""
        hands, opening = self._places(), self.opening
        if not self._closes:
            chance = self.belief.between(hands, opening)
            if chance.max() > 0.3 or self._is_late():
                return float(hands[chance.argmax()])
        if self.tap.scan and self._scanned < self.hidden_range[1]:
            self._scanned += self.tap.scan
            return self._scanned
        return float(hands[self.belief.information(hands, opening).argmax()])

    def _is_late(self) -> bool:
        """Whether the time left is enough for one grasp alone."""
        return self.steps_left < _GRASP_STEPS

    def _tap(self, place: float) -> Verdict:
        """Lowers the hand there. Whether something was in its way."""
        above = self._on_line(place, _TOP + self.tap.clear)
        above[0] -= self.tap.aside
        if self.height() < _TOP:
            yield from self._rise(_TOP + self.tap.clear)
        yield from self._go(above, settle=2)
        self._recalibrate()
        rest = (yield from self._mean_lag()) if self.tap.averaged > 2 else 0.0
        below = above[2] - self.tap.clear - self.tap.depth
        recent: list[float] = []
        while self._sent[2] > below + 1e-4:
            yield self._move(np.array([0, 0, max(below - self._sent[2], -self.tap.step)]))
            recent = [*recent, float(self.lag[2])][-2:]
            if self.tap.step < _SLOW and len(recent) == 2 and np.mean(recent) > max(self.tap.lag, _SURE_LAG):
                return True
        yield from self._wait(1)
        return bool((yield from self._mean_lag()) - rest > self.tap.lag)

    def _mean_lag(self) -> Generator[np.ndarray, None, float]:
        """How much higher than it was sent the hand is [m], over as many measurements as the tap averages."""
        lags = [float(self.lag[2])]
        for _ in range(self.tap.averaged - 1):
            yield self._move(np.zeros(3))
            lags.append(float(self.lag[2]))
        return float(np.mean(lags))

    def _try(self, place: float) -> Actions:
        """Closes the fingers around what should be between them."""
        yield from self._go(self._on_line(place, GRASP_HEIGHT))
        opening = self.opening
        yield from self._grasp()
        self.belief.rule_out(place, opening)
        if self._dropped_something():
            self.belief = CubeBelief(*self.hidden_range)

    def _dropped_something(self) -> bool:
        """Whether what was held is gone: the hand is high, and the fingers are closed on nothing."""
        return self.height() > _TOP + 0.02
