"""The synthesiser as the ears of a task."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from gym_playbyear.contact_kinematics import ContactReader, SoundingPair, add_sensors
from gym_playbyear.ears import HeardPair, Moment
from gym_playbyear.sound_v2 import ContactSynth

_RENAMED = {"bin": "tray"}  # materials that have another name here
_FINGER_CLICK = SoundingPair(("left_finger", "right_finger"), ("gripper", "gripper"), stop="left_finger")


class SyntheticEars:
    """`ContactSynth`: blows, friction and the hand's own drive, as the motion of what touches makes them.

    Args:
        pairs: What can be heard.
        microphones: Names in `gym_playbyear.sound_v2.MICROPHONES`.
        sample_rate: Samples per second.
        control_hz: Control steps per second.
        physics_dt: Duration of a physics step [s].
        noise_level: Factor on noise and hum.
    """

    def __init__(
        self,
        pairs: list[HeardPair],
        microphones: tuple[str, ...],
        sample_rate: int,
        control_hz: int,
        physics_dt: float,
        noise_level: float,
    ):
        self.pairs = [sounding for pair in pairs for sounding in _sounding_pairs(pair)]
        if any(_FINGER_CLICK.bodies[0] in pair.bodies for pair in self.pairs):
            self.pairs.append(_FINGER_CLICK)
        self.synthesis = ContactSynth(self.pairs, microphones, sample_rate, control_hz, physics_dt, noise_level)
        self._reader: ContactReader | None = None

    def add_sensors(self, spec: mujoco.MjSpec) -> None:
        """What tells force, place and speed of every contact."""
        add_sensors(spec, self.pairs)

    def reset(self, rng: np.random.Generator) -> None:
        self.synthesis.reset(rng)

    def step(self, model: mujoco.MjModel, moment: Moment) -> dict[str, np.ndarray]:
        if self._reader is None:
            self._reader = ContactReader(model, self.pairs)
        contacts = self._reader.read(moment.sensordata)
        return self.synthesis.step(
            contacts, moment.joint_speed, moment.finger_speed, moment.microphone_positions, moment.bending
        )


def _sounding_pairs(pair: HeardPair) -> list[SoundingPair]:
    first, second = (_RENAMED.get(material, material) for material in pair.materials)
    return [
        SoundingPair((body, pair.bodies[1]), (first, second), pair.loudness, (has_subtree, True))
        for body, has_subtree in pair.sensed
    ]


class MaterialEars:
    """Ears for things that are made of something else from episode to episode: a synthesiser for each choice of materials.

    Args:
        pairs: What can be heard, of the usual materials.
        rest: Other arguments of `SyntheticEars`.
    """

    def __init__(self, pairs: list[HeardPair], *rest: Any):
        self._pairs, self._rest = pairs, rest
        self._made: dict[tuple[tuple[str, str], ...], Any] = {}
        self.choose({})

    def choose(self, materials: Mapping[str, str]) -> None:
        """What bodies are made of from now on, where that is not the usual.

        Raises:
            ValueError: No contact of such a body can be heard.
        """
        unheard = set(materials) - {body for pair in self._pairs for body in pair.bodies}
        if unheard:
            heard = sorted({body for pair in self._pairs for body in pair.bodies})
            raise ValueError(
                f"materials names {sorted(unheard)}, which no contact is heard of: there are {', '.join(heard)}."
            )
        key = tuple(sorted(materials.items()))
        if key not in self._made:
            self._made[key] = SyntheticEars([_made_of(pair, materials) for pair in self._pairs], *self._rest)
        self._chosen = self._made[key]

    def add_sensors(self, spec: mujoco.MjSpec) -> None:
        self._chosen.add_sensors(spec)

    def reset(self, rng: np.random.Generator) -> None:
        self._chosen.reset(rng)

    def step(self, model: mujoco.MjModel, moment: Moment) -> dict[str, np.ndarray]:
        return self._chosen.step(model, moment)


def _made_of(pair: HeardPair, materials: Mapping[str, str]) -> HeardPair:
    first, second = (materials.get(body, usual) for body, usual in zip(pair.bodies, pair.materials, strict=True))
    return replace(pair, materials=(first, second))
