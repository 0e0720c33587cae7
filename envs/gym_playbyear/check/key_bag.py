"""Groping in a bag without hearing: how deep the things lie is what nobody sees, and what the arm may feel.

The bag's bottom gives way, but it presses back, and the hand then lags behind where it was sent, by some hundredths of a
millimetre for each millimetre that it is pressed down. A script keeps a belief about the bottom's height, goes down at a
constant speed so that the lag is the same but for that, and closes where the things must then be between the fingers. What
the fingers measure tells whether they hold something; if not, it goes on, as long as the attempt lasts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_playbyear.check.deaf import Actions, DeafScript, TaskFacts
from gym_playbyear.panda import FINGER_THICKNESS, TIP_BELOW_HAND, SensorNoise
from gym_playbyear.tasks.arena import TABLE_TOP
from gym_playbyear.tasks.bag import RIM

_RESOLUTION = 0.001  # m
_UNEVEN = 0.0001  # m: the arm's own deviation, from one height to the next
_LAG_NOT_KNOWN = 0.001  # m: of a hand in the air
_GIVE = 0.022  # how much the hand lags behind for what the bottom is pressed down: its stiffness over the arm's
_ABOVE = np.array([[0.0], [0.006], [0.013]])  # m, above the bottom: what the hand meets: it, or things on it
_TOO_FAR = np.array([[0.008], [0.019], [0.019]])  # m: pressed down further, the bag tears, or the hand is stopped
_CATCH = (-0.008, 0.003)  # m: tips so far above the bottom close around what lies on it
_MISTAKE = 0.02
_EMPTY = 0.004  # m: opening of fingers that hold nothing
_CLEAR = 0.028  # m: so high above its highest bottom nothing lies in the bag
_AFTER_CLOSING = 16  # steps from closing fingers to things that were held in sight
_FAST = 0.045  # m per step


@dataclass(frozen=True)
class Grope:
    """How to grope. Lengths in metres.

    Attributes:
        finger: Feels with one of the open fingers first, which costs no closing.
        step: What the hand goes down per control step.
        rests: Steps of rest after each, in which the lag is measured; 0: it is measured on the way.
        places: Where it closes, beside the middle of where the things may lie (x, y); the next one after every closing on
            nothing.
        sure: It closes where the things are between the fingers with this probability.
        dares: It does not go on with so much risk of pressing too hard.
        aside: How far it goes aside where its fingers stand on the things.
    """

    finger: bool = False
    step: float = 0.003
    rests: int = 0
    places: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    sure: float = 0.6
    dares: float = 0.3
    aside: float = 0.02


GROPES = {
    "feel": Grope(),
    "feel_slowly": Grope(step=0.002, sure=0.5),
    "feel_patiently": Grope(step=0.006, rests=2),
    "prod": Grope(finger=True, step=0.003, sure=0.8, dares=0.15),
    "prod_quickly": Grope(finger=True, step=0.006, sure=0.9, dares=0.05, places=((0.0, 0.0), (0.0, 0.012))),
}


class DepthBelief:
    """A probability for each height of the bag's bottom, and for what the hand meets: the bottom, or things on it.

    Args:
        lower, upper: Between which heights the bottom is [m, above the table].
        things: The probability that the hand meets things.
        sensors: What is wrong with what the arm measures.
        rate_hz: Measurements per second.
    """

    def __init__(self, lower: float, upper: float, things: float, sensors: SensorNoise, rate_hz: float):
        self._noise = float(np.hypot(sensors.position, sensors.quantum_position / 3))
        self._wander = float(np.hypot(sensors.wander, _UNEVEN))
        self._kept = float(np.exp(-1 / (sensors.wander_seconds * rate_hz)))
        self._variance = _LAG_NOT_KNOWN**2
        self.heights = np.arange(lower, upper + _RESOLUTION / 2, _RESOLUTION)
        self.met = self.heights + _ABOVE  # (3, heights)
        self._wrong = np.zeros_like(self.met)
        self.probability = np.array([[1 - things], [things / 2], [things / 2]]) * np.full(
            len(self.heights), 1 / len(self.heights)
        )

    def update(self, tips: float, lag: float) -> None:
        """Learns from a measurement: a Kalman filter of what the sensor is wrong by, for each height at once.

        Args:
            tips: Height of the fingers' tips [m, above the table].
            lag: How far the hand is above where it was sent, while it goes down at a constant speed [m].
        """
        surprise = lag - _GIVE * np.clip(self.met - tips, 0, _TOO_FAR.max()) - self._wrong
        spread = self._variance + self._noise**2
        self._wrong = self._wrong + self._variance / spread * surprise
        self._variance *= 1 - self._variance / spread
        self._variance = self._kept**2 * self._variance + (1 - self._kept**2) * self._wander**2
        self._weigh(np.exp(-0.5 * surprise**2 / spread) + 1e-3)

    def survived(self, tips: float) -> None:
        """The attempt goes on: what may not be pressed down further is not that high."""
        self._weigh(np.where(self.met - tips > _TOO_FAR, _MISTAKE, 1.0))

    def rule_out(self, tips: float) -> None:
        """Fingers that closed held nothing."""
        self._weigh(np.where(self._caught(tips), 0.4, 1.0))

    def chance(self, tips: float) -> float:
        """The probability that things are between fingers whose tips are at that height."""
        return float(self.probability[:, self._caught(tips)].sum())

    def best(self) -> float:
        """The tips' height at which that is greatest [m]."""
        tips = np.arange(self.heights[0] + _CATCH[0], self.heights[-1] + _CATCH[1], _RESOLUTION)
        return float(tips[np.argmax(self._caught(tips[:, None]) @ self.probability.sum(axis=0))])

    def danger(self, tips: float, further: float) -> float:
        """The probability that a step of that length presses too hard [m]."""
        return float(self.probability[self.met - tips > _TOO_FAR - further].sum())

    def stands(self, tips: float) -> float:
        """The probability that the hand stands on things."""
        return float(self.probability[1:][self.met[1:] - tips > 0.003].sum())

    def _caught(self, tips: float | np.ndarray) -> np.ndarray:
        above = tips - self.heights
        return (above > _CATCH[0]) & (above < _CATCH[1])

    def _weigh(self, likelihood: np.ndarray) -> None:
        self.probability = self.probability * likelihood
        self.probability /= self.probability.sum()


class GropingScript(DeafScript):
    """Goes down, feels for the bottom, closes, lifts.

    Args:
        facts, rng: As of every script.
        grope: How to grope.
        bottom: Between which heights the bag's bottom is [m, above the table].
        sensors: What is wrong with what the arm measures.
        middles: Where the things may lie (x, y) [m, world]; it goes to another one after every closing on nothing.
    """

    def __init__(
        self,
        facts: TaskFacts,
        rng: np.random.Generator,
        grope: Grope,
        bottom: tuple[float, float],
        sensors: SensorNoise,
        middles: Sequence[np.ndarray],
    ):
        self.grope, self.bottom, self.sensors, self.middles = grope, bottom, sensors, middles
        super().__init__(facts, rng)

    def _plan(self) -> Actions:
        things = 0.9 if self.grope.finger else 0.5
        self.belief = DepthBelief(*self.bottom, things, self.sensors, self.facts.control_hz)
        self._n_closings, self._first = 0, int(self.rng.integers(len(self.middles)))
        self._shift = np.zeros(2)
        if self.grope.finger:
            self._shift = np.array(
                [0.0, self.rng.choice([-1.0, 1.0]) * (self.facts.max_opening + FINGER_THICKNESS) / 2]
            )
        yield from self._travel()
        if self.grope.finger:
            yield from self._prod()
            yield from self._grasp_at_best()
            yield from self._grasp_at_best()
        while True:
            yield from self._descend()
            if self.belief.stands(self._tips()) > 0.6 and self.steps_left > _AFTER_CLOSING:
                yield from self._go_aside()
            yield from self._close()

    def _prod(self) -> Actions:
        """Feels for the height of what lies in the middle."""
        yield from self._descend()
        self._shift = np.zeros(2)
        yield from self._rise_over(self.belief.best())

    def _grasp_at_best(self) -> Actions:
        yield from self._rise_over(self.belief.best())
        yield from self._lower_to(self.belief.best())
        yield from self._close()

    def _travel(self) -> Actions:
        """To above the next place, over all that may lie there."""
        yield from self._rise_over(self.bottom[1])

    def _rise_over(self, bottom: float) -> Actions:
        """To above the next place, over what may lie on a bottom of that height."""
        yield from self._go(np.array([*self._sent[:2], TABLE_TOP + bottom + _CLEAR + TIP_BELOW_HAND]), _FAST)
        yield from self._go(np.array([*self._entry(), self._sent[2]]), _FAST)

    def _entry(self) -> np.ndarray:
        """(2,) where to go down [m, world]."""
        place = self.grope.places[self._n_closings % len(self.grope.places)]
        return self.middles[(self._first + self._n_closings) % len(self.middles)] + place + self._shift

    def _tips(self) -> float:
        """Where the fingers' tips were sent [m, above the table]."""
        return float(self._sent[2] - TIP_BELOW_HAND - TABLE_TOP)

    def _descend(self) -> Actions:
        """Down until the bottom's height is known well enough, or time is short."""
        grope, belief, n_steps = self.grope, self.belief, 0
        while self._tips() > self.bottom[0] - 0.004 and self.steps_left > _AFTER_CLOSING:
            yield self._move(np.array([0, 0, -grope.step]))
            n_steps += 1
            for _ in range(grope.rests):
                yield self._move(np.zeros(3))
                self._feel(n_steps)
            if not grope.rests:
                self._feel(n_steps)
            belief.survived(self._tips())
            tips = self._tips()
            chance = belief.chance(belief.best()) if self.grope.finger else belief.chance(tips)
            if chance > grope.sure:
                return
            if belief.danger(tips, grope.step) > grope.dares:
                if not self.grope.finger:
                    yield from self._lower_to(belief.best())
                return

    def _feel(self, n_steps: int) -> None:
        """Weighs what is measured now."""
        if n_steps > 1:  # the first step is not at full speed
            self.belief.update(self._tips(), float(self.lag[2]))

    def _lower_to(self, tips: float) -> Actions:
        """Straight to where the tips are so high above the table [m]."""
        yield from self._go(np.array([*self._entry(), TABLE_TOP + tips + TIP_BELOW_HAND]), 0.02)

    def _go_aside(self) -> Actions:
        """The fingers stand on the things: up, a little aside, and down again."""
        self._shift = self.rng.choice([-1.0, 1.0]) * np.array([0.0, self.grope.aside])
        yield from self._rise_over(self.belief.best())
        yield from self._lower_to(self.belief.best())

    def _close(self) -> Actions:
        """Closes where the hand is, and lifts what it holds. Ends when it holds nothing."""
        tips = self._tips()
        yield from self._set_grip(True)
        if self.holds:
            yield from self._go(np.array([*self._sent[:2], RIM + 0.055]), 0.03)
        while self.holds:  # success is for the environment to see
            yield self._move(np.zeros(3))
        self._n_closings += 1
        self.belief.rule_out(tips)
        yield from self._rise_over(self.belief.best() if self.grope.finger else self.bottom[1])
        yield from self._set_grip(False)

    @property
    def holds(self) -> bool:
        return self._closes and self.opening > _EMPTY
