"""Deaf scripts for a hidden cube: tapping, nudging, jamming and creeping.

Tapping: a hand that is lowered stops higher where it lands on the cube than beside it, and the arm's own position says so.
A script keeps a belief about the cube's place, taps where a tap tells most, and closes where the cube should be between the
fingers. If it holds nothing it goes on, as long as the attempt lasts.

The others feel nothing. Nudging: a cube may be moved some way before the attempt has failed, so the hand sweeps just that far
and grasps where a cube that it met must then be; then the next stretch. Jamming: a cube that counts as held may be pushed
anywhere, so the hand presses it against what lies across the line, pushes it to the range's end and grasps there. Creeping: a
hand that never stops has stopped everywhere, if it is slow.
"""

from collections.abc import Generator
from dataclasses import dataclass
from functools import partial

import numpy as np

from gym_playbyear.check.deaf import FAST, GRASP_HEIGHT, TRAVEL_HEIGHT, Actions, DeafScript, ScriptMaker, TaskFacts
from gym_playbyear.panda import FINGER_THICKNESS, FINGER_WIDTH, TIP_BELOW_HAND
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE

_RESOLUTION = 0.001  # m
_YAWS = np.deg2rad(np.linspace(0, 15, 4))  # either way is the same
_SOFTNESS = 0.001  # m: edges are no sharper than this
_MISTAKE = 0.01  # share of taps that lie
_DRIFT = 0.001  # m: a blocked tap may move the cube that far


def half_extents() -> np.ndarray:
    """(4,) how far a cube of each yaw reaches along the line, as far as the fingers are wide [m]."""
    across = min(FINGER_WIDTH / 2, CUBE_HALF_SIZE)
    return (CUBE_HALF_SIZE + across * np.sin(_YAWS)) / np.cos(_YAWS)


class CubeBelief:
    """A probability for each place of the cube and yaw.

    Args:
        lower, upper: Where the cube's centre may be [m].
        slides: A finger that meets no more of the cube's rim than this slides off and pushes the cube aside [m].
        margin: How far outside it may be after a push [m].
    """

    def __init__(self, lower: float, upper: float, slides: float = 0.003, margin: float = 0.01):
        self.slides = slides
        self.places = np.arange(lower - margin, upper + margin, _RESOLUTION)
        self.extents = half_extents()
        inside = (self.places >= lower) & (self.places <= upper)
        self.probability = np.repeat((inside + 1e-4)[:, None], len(self.extents), axis=1)  # (places, yaws)
        self.probability /= self.probability.sum()

    def blocked(self, hand: float | np.ndarray, opening: float) -> np.ndarray:
        """The chance that a hand lowered at `hand` comes down on the cube, (..., places, yaws).

        Args:
            hand: Along the line [m], one or (...,).
            opening: Between the fingers [m].
        """
        # By symmetry of one finger (..., places, 1).
        offset = np.abs(np.asarray(hand)[..., None, None] - self.places[:, None])
        inner, outer = opening / 2, opening / 2 + FINGER_THICKNESS
        # Negative where it rests on the cube.
        gap = np.maximum(offset - outer, inner - offset) - self.extents + self.slides
        return _MISTAKE + (1 - 2 * _MISTAKE) / (1 + np.exp(np.clip(gap / _SOFTNESS, -50, 50)))

    def between(self, hand: float | np.ndarray, opening: float) -> np.ndarray:
        """The probability that the cube is between open fingers that come down at `hand` (...,)."""
        offset = np.abs(np.asarray(hand)[..., None, None] - self.places[:, None])
        return np.sum((offset + self.extents < opening / 2 + self.slides) * self.probability, axis=(-2, -1))

    def update(self, hand: float, opening: float, was_blocked: float) -> None:
        """Learns from a tap.

        Args:
            hand: Along the line [m].
            opening: Between the fingers [m].
            was_blocked: How sure it is that something was in the way, from 0 to 1.
        """
        chance = self.blocked(hand, opening)
        self.probability = self.probability * (chance * was_blocked + (1 - chance) * (1 - was_blocked))
        if was_blocked > 0.5:
            kernel = np.exp(-0.5 * (np.arange(-3, 4) * _RESOLUTION / _DRIFT) ** 2)
            kernel /= kernel.sum()
            spread = [np.convolve(column, kernel, mode="same") for column in self.probability.T]
            self.probability = np.stack(spread, axis=1)
        self.probability /= self.probability.sum()

    def rule_out(self, hand: float, opening: float) -> None:
        """Fingers that closed at `hand` held nothing: the cube was not between them."""
        offset = np.abs(hand - self.places)
        self.probability[offset < opening / 2 - CUBE_HALF_SIZE] *= _MISTAKE
        self.probability /= self.probability.sum()

    def information(self, hands: np.ndarray, opening: float) -> np.ndarray:
        """What a tap at each of `hands` (N,) would tell [bit], (N,)."""
        chance = self.blocked(hands, opening)  # (N, places, yaws)
        overall = np.sum(chance * self.probability, axis=(1, 2))
        return _entropy(overall) - np.sum(_entropy(chance) * self.probability, axis=(1, 2))

    def mean(self) -> float:
        """[m]"""
        return float(np.sum(self.probability.sum(axis=1) * self.places))


def _entropy(chance: np.ndarray) -> np.ndarray:
    return -(chance * np.log2(chance) + (1 - chance) * np.log2(1 - chance))


_TOP = 2 * CUBE_HALF_SIZE + TIP_BELOW_HAND  # m: the hand's height above the table when the tips rest on the cube
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
        slides: A finger that meets no more of the cube's rim than this slides off.
        sure: The script closes the fingers where the cube is between them with this probability.
    """

    closed: bool = False
    step: float = FAST
    depth: float = 0.010
    clear: float = 0.008
    lag: float = 0.0007
    patience: int = 1
    slides: float = 0.003
    sure: float = 0.5


TAPS = {
    "tap_fast": Tap(),
    "tap_breath": Tap(step=0.01, depth=0.0004, clear=0.003, lag=0.0001, patience=20, slides=0.0),
    "tap_closed": Tap(closed=True),
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
        self._knows_height = self._must_dare = False
        if self.tap.closed:
            yield from self._set_grip(True)
        while True:
            if self._closes and self._is_narrow():
                yield from self._set_grip(False)
            place = self._choose()
            blocked = yield from self._tap(place)
            self.belief.update(place, self.opening, blocked)
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
        return float(hands[told.argmax()])

    def _is_late(self) -> bool:
        """Whether the time left is enough for one grasp alone."""
        return self.steps_left < _GRASP_STEPS

    def _tap(self, place: float) -> Generator[np.ndarray, None, float]:
        """Lowers the hand there. How sure it is that something was in its way, from 0 to 1."""
        above = self._on_line(place, _TOP + self.tap.clear)
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
        while self._sent[2] > below + 1e-4:
            yield self._move(np.array([0, 0, max(below - self._sent[2], -self.tap.step)]))
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


_NUDGE_STEP = 0.008  # m: what the hand covers per control step
_SPARE = 0.003  # m: so much less than is allowed the cube is moved
_FURTHER = 0.002  # m: so far past its place the fingers close
_RUN_UP = 0.014  # m before the nearest possible cube
_BACK_OFF = 0.004  # m


class NudgingScript(DeafScript):
    """Sweeps, then grasps where the cube must be."""

    def _plan(self) -> Actions:
        lower, upper = self.hidden_range
        searched = lower  # nearer than this the cube is not
        while True:
            reach = self.opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE
            yield from self._go_low(searched - reach - _RUN_UP)
            allowed = min(self.facts.max_shove - _SPARE, upper - lower)
            yield from self._sweep(min(searched + allowed, upper) - reach)
            found = float(self.hand[1]) + reach
            yield from self._go(self._sent - np.array([0, _BACK_OFF, 0]))
            yield from self._go_low(found + _FURTHER, opens=True)
            yield from self._grasp()
            searched = found + CUBE_HALF_SIZE / 2
            if searched > upper:
                searched = lower

    def _go_low(self, y: float, opens: bool = False) -> Actions:
        """To above a point of the line [m], and down to the height of the sweep; with open fingers around a cube."""
        yield from self._rise(TRAVEL_HEIGHT)
        if opens:
            yield from self._set_grip(False)
        yield from self._go(self._on_line(y, TRAVEL_HEIGHT), settle=2)
        if not opens:
            self._recalibrate()
        yield from self._go(self._on_line(y, GRASP_HEIGHT), 0.02, settle=2)

    def _sweep(self, end: float) -> Actions:
        """Along the line to `end` [m]."""
        while self._sent[1] < end - 1e-4:
            yield self._move(np.array([0, min(_NUDGE_STEP, end - self._sent[1]), 0]))
        yield from self._wait(1)


_JAM_HEIGHT, _JAM_SPACING = 0.033, 0.05  # m above the table; between two pushes across the line
_JAM_FROM, _JAM_TO = -0.06, -0.015  # m beside the line: from where to where


class JammingScript(DeafScript):
    """Pushes across the line everywhere, sweeps all of it, and grasps at its end."""

    def _plan(self) -> Actions:
        lower, upper = self.hidden_range
        n_pushes = int(np.ceil((upper - lower) / _JAM_SPACING))
        for y in lower + (np.arange(n_pushes) + 0.5) * (upper - lower) / n_pushes:
            for x, step, settle in ((_JAM_FROM, 0.04, 1), (_JAM_TO, 0.02, 1), (_JAM_FROM, 0.04, 0)):
                yield from self._go(self._on_line(y, _JAM_HEIGHT) + np.array([x, 0, 0]), step, settle=settle)
        yield from self._rise(TRAVEL_HEIGHT)
        start, end = lower - self.reach - 0.02, upper - self.reach + 0.005
        for y, height, step in ((start, TRAVEL_HEIGHT, 0.04), (start, GRASP_HEIGHT, 0.02), (end, GRASP_HEIGHT, 0.012)):
            yield from self._go(self._on_line(y, height), step)
        found = float(self.hand[1]) + self.reach + _FURTHER
        yield from self._go(self._sent - np.array([0, _BACK_OFF, 0]))
        yield from self._rise(TRAVEL_HEIGHT)
        for height in (TRAVEL_HEIGHT, GRASP_HEIGHT):
            yield from self._go(self._on_line(found, height), 0.02, settle=2)
        yield from self._grasp()


_CREEP_STEP, _CREEP_HEIGHT = 0.0011, 0.03  # m


class CreepingScript(DeafScript):
    """Moves on so slowly that it is beside what it comes to for a second, as far towards the range's end as time allows."""

    def _plan(self) -> Actions:
        lower, upper = self.hidden_range
        end = upper - self.reach
        start = max(end - _CREEP_STEP * self.steps_left, lower - self.reach - _RUN_UP)
        for height in (TRAVEL_HEIGHT, _CREEP_HEIGHT):
            yield from self._go(self._on_line(start, height), 0.05, settle=0)
        yield from self._go(self._on_line(end, _CREEP_HEIGHT), _CREEP_STEP, settle=self.facts.horizon)


SCRIPTS: dict[str, ScriptMaker] = {
    **{name: partial(TappingScript, tap=tap) for name, tap in TAPS.items()},
    "nudge": NudgingScript,
    "jam": JammingScript,
    "creep": CreepingScript,
}
"""For all tasks whose camera shows a `hidden_range`, by name."""
