"""Where the hidden cube may be, as far as taps tell: probabilities over its place along the line and its yaw."""

import numpy as np

from gym_playbyear.arena import CUBE_HALF_SIZE
from gym_playbyear.arm import FINGER_THICKNESS, FINGER_WIDTH

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
        offset = np.abs(
            np.asarray(hand)[..., None, None] - self.places[:, None]
        )  # (..., places, 1): by symmetry one finger
        inner, outer = opening / 2, opening / 2 + FINGER_THICKNESS
        gap = (
            np.maximum(offset - outer, inner - offset) - self.extents + self.slides
        )  # negative where it rests on the cube
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
