"""Tapping: a hand that is lowered stops higher where it lands on the cube than beside it, and the arm's own position says so.

A script keeps a belief about the cube's place, taps where a tap tells most, and closes where the cube should be between the
fingers. If it holds nothing it goes on, as long as the attempt lasts.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from gym_playbyear.adversaries.belief import CubeBelief
from gym_playbyear.adversaries.script import FAST, GRASP_HEIGHT, TIP_BELOW_HAND, Actions, DeafScript
from gym_playbyear.adversaries.view import TaskFacts
from gym_playbyear.arena import CUBE_HALF_SIZE

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
        lag: A hand that is this much higher than it was sent is as likely blocked as not.
        patience: So many measurements are weighed against each other at most; with one, a look decides.
        aside: How far beside the line the hand taps, so that its fingers meet the cube's rim alone.
        scan: From one end of the range to the other in steps of this length; None: where a tap tells most.
        slides: A finger that meets no more of the cube's rim than this slides off.
        sure: The script closes the fingers where the cube is between them with this probability.
    """

    closed: bool = False
    step: float = FAST
    depth: float = 0.010
    clear: float = 0.008
    lag: float = 0.0007
    patience: int = 1
    aside: float = 0.0
    scan: float | None = None
    slides: float = 0.003
    sure: float = 0.5


TAPS = {
    "tap_fast": Tap(),
    "tap_gentle": Tap(step=0.001, depth=0.004, clear=0.003, lag=0.0005),
    "tap_feather": Tap(step=0.01, depth=0.0014, clear=0.003, lag=0.00013, patience=14, slides=0.0),
    "tap_breath": Tap(step=0.01, depth=0.0004, clear=0.003, lag=0.0001, patience=20, slides=0.0),
    "tap_closed": Tap(closed=True),
    "tap_along": Tap(scan=0.012),
    "tap_across": Tap(aside=0.022),
}
_WORTH_A_TAP = 0.3  # probability that the cube is between the fingers there
_NOTHING_TOLD = 0.15  # bit
_NOISE = 0.0003  # m: of one measurement of the hand's place
_DECIDED = 2.0  # log odds at which a patient script has seen enough
_FIRST_LOOK = 16  # measurements from which a patient script learns its height


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
        self.belief = CubeBelief(*self.hidden_range, self.tap.slides)
        self._scanned = self.hidden_range[0] - self.reach
        self._knows_height = self._must_dare = False
        if self.tap.closed:
            yield from self._set_grip(True)
        while True:
            if self._closes and self._is_narrow():
                yield from self._set_grip(False)
            place = self._choose()
            blocked = yield from self._tap(place)
            self.belief.update(place, self.opening, blocked)
            if blocked > 0.5:
                self._scanned = np.inf
            sure = self.belief.between(place, self.opening) > (0 if self._must_dare else self.tap.sure)
            if blocked < 0.5 and not self._closes and sure:
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
        told = self.belief.information(hands, opening)
        chance = self.belief.between(hands, opening)
        best = int(chance.argmax())
        self._must_dare = self._is_late() or bool(told.max() < _NOTHING_TOLD)
        if not self._closes and (self._must_dare or (chance[best] > _WORTH_A_TAP and told[best] > _NOTHING_TOLD)):
            return float(hands[best])
        if self.tap.scan and self._scanned < self.hidden_range[1]:
            self._scanned += self.tap.scan
            return self._scanned
        return float(hands[told.argmax()])

    def _is_late(self) -> bool:
        """Whether the time left is enough for one grasp alone."""
        return self.steps_left < _GRASP_STEPS

    def _tap(self, place: float) -> Generator[np.ndarray, None, float]:
        """Lowers the hand there. How sure it is that something was in its way, from 0 to 1."""
        above = self._on_line(place, _TOP + self.tap.clear)
        above[0] -= self.tap.aside
        if self.height() < _TOP:
            yield from self._rise(_TOP + self.tap.clear)
        yield from self._go(above, settle=2)
        self._recalibrate(slice(0, 2) if self.tap.patience > 1 else slice(0, 3))
        if self.tap.patience > 1 and not self._knows_height:
            lags = []
            for _ in range(_FIRST_LOOK):
                lags.append(float(self.lag[2]))
                yield self._move(np.zeros(3))
            self._sent[2] += np.mean(lags)
            self._knows_height = True
        below = above[2] - self.tap.clear - self.tap.depth
        recent: list[float] = []
        while self._sent[2] > below + 1e-4:
            yield self._move(np.array([0, 0, max(below - self._sent[2], -self.tap.step)]))
            recent = [*recent, float(self.lag[2])][-2:]
            if self.tap.step < _SLOW and len(recent) == 2 and np.mean(recent) > max(self.tap.lag, _SURE_LAG):
                return 1.0
        yield from self._wait(1)
        return (yield from self._weigh())

    def _weigh(self) -> Generator[np.ndarray, None, float]:
        """How sure it is that the lowered hand is blocked, from 0 to 1."""
        if self.tap.patience == 1:
            return float(self.lag[2] > self.tap.lag)
        odds = 0.0
        for _ in range(self.tap.patience):
            odds += 2 * self.tap.lag * (float(self.lag[2]) - self.tap.lag) / _NOISE**2
            if abs(odds) > _DECIDED:
                break
            yield self._move(np.zeros(3))
        return float(1 / (1 + np.exp(-odds)))

    def _try(self, place: float) -> Actions:
        """Closes the fingers around what should be between them."""
        yield from self._go(self._on_line(place, GRASP_HEIGHT))
        opening = self.opening
        yield from self._grasp()
        self.belief.rule_out(place, opening)
        if self._dropped_something():
            self.belief = CubeBelief(*self.hidden_range, self.tap.slides)

    def _dropped_something(self) -> bool:
        """Whether what was held is gone: the hand is high, and the fingers are closed on nothing."""
        return self.height() > _TOP + 0.02
