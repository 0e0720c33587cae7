"""Between physics and sound: what a synthesiser is told of a control step."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gym_playbyear.sound_v2_crackle import Bending


@dataclass(frozen=True)
class HeardPair:
    """Two things whose contact can be heard.

    Attributes:
        bodies: Their names; "gripper" is the hand with its fingers.
        materials: Of the two, in the same order.
        loudness: Factors on their shares of the sound.
        loose: Which of the two move freely: they carry sound to what they press against.
        sensed: The model's bodies that stand for the first thing, each with whether all that hangs on it counts; a hand that
            squeezes is several, since in one the forces would cancel. The second thing is the body of its name, with all of it.
    """

    bodies: tuple[str, str]
    materials: tuple[str, str]
    loudness: tuple[float, float] = (1.0, 1.0)
    loose: frozenset[str] = frozenset()
    sensed: tuple[tuple[str, bool], ...] = ()


@dataclass(frozen=True)
class Moment:
    """One control step, T physics steps, as far as it can be heard.

    Attributes:
        forces: Magnitude of each pair's contact force (T, n_pairs) [N].
        sensordata: All that the model's sensors measured (T, nsensordata).
        joint_speed: Mean absolute speed of the arm's joints (T,) [rad/s].
        finger_speed: Mean absolute speed of the fingers (T,) [m/s].
        states: Full state of the physics (T, size of `mjSTATE_FULLPHYSICS`).
        microphone_positions: Where each microphone is at the end of the step (3,) [m, world].
        bending: Of the things that crackle when they bend, by name.
    """

    forces: np.ndarray
    sensordata: np.ndarray
    joint_speed: np.ndarray
    finger_speed: np.ndarray
    states: np.ndarray
    microphone_positions: dict[str, np.ndarray]
    bending: Mapping[str, Bending] = field(default_factory=dict)
