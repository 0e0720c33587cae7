"""Shoving and batting: a hand that sweeps through the range has the cube in front of it, if it met the cube at all.

`nudge` feels nothing: a cube may be moved some way before the attempt has failed, so it sweeps just that far and grasps where a
cube that it met must then be; then the next stretch. `nudge_beside` does not even come down from above, where the hand
could land on the cube, but from beside the line. `shove` (open fingers, slow) and `bat` (closed fingers, fast) watch the arm's
lag besides, and stop where it grows.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.adversaries.script import GRASP_HEIGHT, TRAVEL_HEIGHT, Actions, DeafScript, Verdict
from gym_playbyear.adversaries.view import TaskFacts
from gym_playbyear.arena import CUBE_HALF_SIZE
from gym_playbyear.arm import FINGER_THICKNESS


@dataclass(frozen=True)
class Shove:
    """How to shove. Lengths in metres.

    Attributes:
        step: What the hand covers per control step.
        closed: With closed fingers.
        feels: Stops where the arm's lag grows.
        beside: Comes around the cube from beside the line, not from above.
        drift, alarm: The lag counts as grown when its excess over its mean and `drift`, summed up, reaches `alarm`.
        spare: How much less than what is allowed the cube is moved.
        further: How far past the shoved cube's place the fingers close, for the sake of cubes just beyond.
    """

    step: float = 0.008
    closed: bool = False
    feels: bool = False
    beside: bool = False
    drift: float = 0.00025
    alarm: float = 0.0012
    spare: float = 0.003
    further: float = 0.002


SHOVES = {
    "shove": Shove(step=0.005, feels=True),
    "bat": Shove(step=0.025, closed=True, feels=True),
    "nudge": Shove(),
    "nudge_beside": Shove(beside=True, spare=0.007),
}
_RUN_UP = 0.014  # m before the nearest possible cube
_BACK_OFF = 0.004  # m
_ASIDE = 0.055  # m: beside the line a hand passes the cube
_SIDE_GRIP = 0.020  # m short of the line: that deep the fingers are around the cube


class ShovingScript(DeafScript):
    """Sweeps, then grasps where the cube must be.

    Args:
        facts, rng: As of every script.
        shove: How to shove.
    """

    def __init__(self, facts: TaskFacts, rng: np.random.Generator, shove: Shove):
        self.shove = shove
        super().__init__(facts, rng)

    def _plan(self) -> Actions:
        lower, upper = self.hidden_range
        searched = lower  # nearer than this the cube is not
        if self.shove.closed:
            yield from self._set_grip(True)
        while True:
            reach = self.opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE
            yield from self._go_low(searched - reach - _RUN_UP)
            allowed = min(self.facts.max_shove - self.shove.spare, upper - lower)
            felt = yield from self._sweep(min(searched + allowed, upper) - reach)
            found = float(self.hand[1]) + reach
            yield from self._go(self._sent - np.array([0, _BACK_OFF, 0]))
            yield from self._come_around(found + (0 if felt else self.shove.further))
            yield from self._grasp()
            searched = found + CUBE_HALF_SIZE / 2
            if searched > upper:
                searched = lower

    def _go_low(self, y: float) -> Actions:
        """Beside the range's part that was not searched yet, at the height of the sweep."""
        yield from self._rise(TRAVEL_HEIGHT)
        yield from self._go(self._on_line(y, TRAVEL_HEIGHT), settle=2)
        self._recalibrate()
        yield from self._go(self._on_line(y, GRASP_HEIGHT), 0.02, settle=2)

    def _sweep(self, end: float) -> Verdict:
        """Along the line to `end` [m]. Whether the arm felt something."""
        lags: list[float] = []
        excess = 0.0
        while self._sent[1] < end - 1e-4:
            yield self._move(np.array([0, min(self.shove.step, end - self._sent[1]), 0]))
            lags.append(float(self.lag[1]))
            if len(lags) > 3:
                excess = max(0.0, excess + float(np.mean(lags[1:-1])) - lags[-1] - self.shove.drift)
                if self.shove.feels and excess > self.shove.alarm:
                    return True
        yield from self._wait(1)
        return False

    def _come_around(self, y: float) -> Actions:
        """Brings open fingers to where they close around a cube at `y` [m]."""
        if self.shove.beside:
            aside = np.array([_ASIDE, 0, 0])
            yield from self._go(np.array([self.facts.line_x, self._sent[1], self._sent[2]]) - aside, 0.02)
            yield from self._set_grip(False)
            yield from self._go(self._on_line(y, GRASP_HEIGHT) - aside, 0.02)
            yield from self._go(self._on_line(y, GRASP_HEIGHT) - np.array([_SIDE_GRIP, 0, 0]), 0.02, settle=2)
            return
        yield from self._rise(TRAVEL_HEIGHT)
        yield from self._set_grip(False)
        yield from self._go(self._on_line(y, TRAVEL_HEIGHT), settle=2)
        yield from self._go(self._on_line(y, GRASP_HEIGHT), 0.02, settle=2)
