"""Microphones, and how sound reaches them: through what they are fixed to, what presses against that, or the air.

Gains are chosen, except that sound in air falls with distance; delays are distance over the speed of sound.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gym_playbyear.registry import Registry

_HALVED_AT = 0.1  # m through structure at which a sound has half its amplitude
_PASSED_ON = 0.5  # what a firm contact lets through
_FIRM = 0.5  # N: a contact that presses so hard lets half of that through
_HOPS = 2  # contacts on a path: a screw, the pouch, the finger
_AIR_GAIN = 10 ** (-30 / 20)  # at `_AIR_DISTANCE`, relative to structure
_AIR_DISTANCE = 0.3  # m
_DETOUR = 0.1  # m: from one finger through the hand to the other; what gets through weakly took a longer way
_NEAREST = 0.15  # m: a thing that sounds is no point
_SPEED_IN_AIR, _SPEED_IN_STRUCTURE = 343.0, 2000.0  # m/s (bending waves of a few kHz in centimetres of metal)


@dataclass(frozen=True)
class Microphone:
    """A microphone.

    Attributes:
        structure: Bodies whose sound reaches it through solid matter, with gains; 1 is the body that it is fixed to.
        hum: Gain of the arm's motors.
        drive: Gain of the hand's own motor.
        air: Gain of what comes through the air.
        place: Where it is [m, world frame], if it is named for no part of the arm.
    """

    structure: Mapping[str, float] = field(default_factory=dict)
    hum: float = 1.0
    drive: float = 1.0
    air: float = 1.0
    place: tuple[float, float, float] = (0.6, 0.0, 1.2)


def _robot(**nearer: float) -> dict[str, float]:
    links = {"gripper": 1.0, "hand": 1.0, "link7": 0.8, "link6": 0.6, "link5": 0.5, "link4": 0.35, "link3": 0.25}
    return links | {"left_finger": 0.8, "right_finger": 0.8} | nearer


MICROPHONES: dict[str, Microphone] = {
    # Touches the gripper (paper, real-robot set-up).
    "gripper": Microphone(_robot()),
    # One on each finger; a finger's carriage keeps part of its sound from the hand and from the other finger.
    "left_finger": Microphone(_robot(left_finger=1.0, right_finger=0.2, hand=0.4, gripper=0.5), hum=0.5, drive=0.7),
    "right_finger": Microphone(_robot(right_finger=1.0, left_finger=0.2, hand=0.4, gripper=0.5), hum=0.5, drive=0.7),
    "table": Microphone(
        {"table": 1.0, "wall": 0.7, "tray": 0.7, "bin": 0.7}, hum=0.3, drive=0.05, place=(0.35, 0.0, 0.8)
    ),
    # Touches nothing, and hears the air as the others do: the room's background and its noise are as loud as at the gripper.
    "room": Microphone(hum=0.2, drive=0.03),
}


ALL_MICROPHONES = Registry("microphones", MICROPHONES)
"""Ours, and those of other distributions (`gym_playbyear.registry`)."""


class Paths:
    """Gains and delays from sources to microphones.

    Args:
        microphones: In the order of the results.
        sources: The two bodies of each source; twice the same for a body that sounds alone.
    """

    def __init__(self, microphones: Sequence[Microphone], sources: Sequence[tuple[str, str]]) -> None:
        bodies = list(dict.fromkeys(body for source in sources for body in source))
        self._sides = np.array([[bodies.index(body) for body in source] for source in sources]).T  # (2, n_sources)
        self._fixed = np.array([[m.structure.get(body, 0.0) for body in bodies] for m in microphones])
        self._air = np.array([m.air for m in microphones])
        # What contacts pass on: from the first body of each to the second, and then from the second to the first.
        self._from = np.concatenate([self._sides[0], self._sides[1]])
        self._to = np.eye(len(bodies))[np.concatenate([self._sides[1], self._sides[0]])]  # (2 n_sources, n_bodies)

    def reset(self, structure: float, air: float) -> None:
        """Starts an episode with factors on what contacts pass on and on what comes through the air."""
        self._passed_on, self._air_gain = min(0.9, _PASSED_ON * structure), _AIR_GAIN * air

    def gains(self, normal_force: np.ndarray, position: np.ndarray, ears: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From every source to every microphone at every physics step.

        Args:
            normal_force: (n_substeps, n_sources) [N], 0 where a source is no contact.
            position: (n_substeps, n_sources, 3) [m, world].
            ears: Of the microphones, (n_microphones, 3) [m, world].

        Returns:
            Gains, and delays [s], both (n_microphones, n_substeps, n_sources).
        """
        offset = position[None] - ears[:, None, None]
        distance = np.sqrt(np.einsum("mspc,mspc->msp", offset, offset))
        reach = self._reach(normal_force)  # (n_microphones, n_substeps, n_bodies)
        reach = np.maximum(reach[:, :, self._sides[0]], reach[:, :, self._sides[1]])
        inside = reach / (1.0 + distance / _HALVED_AT)
        outside = (self._air_gain * self._air[:, None, None]) * (_AIR_DISTANCE / np.maximum(distance, _NEAREST))
        inner_delay = (distance + _DETOUR * (1.0 - reach)) / _SPEED_IN_STRUCTURE
        is_inside = inside > outside
        return np.where(is_inside, inside, outside), np.where(is_inside, inner_delay, distance / _SPEED_IN_AIR)

    def _reach(self, normal_force: np.ndarray) -> np.ndarray:
        """How well each body is heard through structure: fixed to the microphone, or over contacts that press."""
        fixed = np.broadcast_to(self._fixed[:, None], (len(self._fixed), len(normal_force), self._fixed.shape[1]))
        if not normal_force.any() or not self._fixed.any():
            return fixed
        passed_on = self._passed_on * normal_force / (normal_force + _FIRM)
        passed_on = np.concatenate([passed_on, passed_on], axis=1)  # (n_substeps, 2 n_sources)
        reach = fixed
        for _ in range(_HOPS):
            reach = np.maximum(fixed, np.minimum((passed_on * reach[:, :, self._from]) @ self._to, 1.0))
        return reach
