"""Version 2 of the sound as the ears of a task: `Task(sound=SyntheticEars, ...)`."""

import mujoco
import numpy as np

from gym_playbyear.contact_kinematics import ContactReader, SoundingPair, add_sensors
from gym_playbyear.ears import USUAL_RMS, HeardPair, Moment
from gym_playbyear.sound_v2 import BACKGROUND, ContactSynth

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

    Attributes:
        background_rms: Of noise and hum, relative to full scale.
    """

    background_rms = BACKGROUND * USUAL_RMS

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
