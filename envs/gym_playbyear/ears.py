"""Between physics and sound: what a synthesiser is told of a control step, and the one of contact forces alone."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import mujoco
import numpy as np

from gym_playbyear.materials import ContactPair
from gym_playbyear.sound_v2_crackle import Bending

USUAL_RMS = 10 ** (-60 / 20)
"""Of version 0's background noise and hum, relative to full scale."""


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


class Ears(Protocol):
    """What an environment needs of a synthesiser. It is copied and pickled with its environment."""

    def add_sensors(self, spec: mujoco.MjSpec) -> None:
        """Adds to the scene, before it is compiled, what has to be measured for the sound."""
        ...

    def reset(self, rng: np.random.Generator) -> None:
        """An episode begins."""
        ...

    def step(self, model: mujoco.MjModel, moment: Moment) -> dict[str, np.ndarray]:
        """The samples of each microphone, int16, (sample_rate / control_hz,)."""
        ...


class ForceEars:
    """`ContactSound`: the force between two bodies is all that it hears of their contact.

    Args:
        pairs: What can be heard, in the order of `Moment.forces`.
        microphones: Names in `gym_playbyear.materials.MICROPHONES`.
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
        # Here, since it takes a second: whoever only asks what a task observes does not need it.
        from gym_playbyear.sound import ContactSound

        named = [
            ContactPair(name="-".join(p.bodies), materials=p.materials, bodies=p.bodies, loose=p.loose) for p in pairs
        ]
        # The quieter of the two decides; a blow is as loud as the square root of its force.
        self._loudness = np.array([min(pair.loudness) ** 2 for pair in pairs])
        self.synthesis = ContactSound(named, microphones, sample_rate, control_hz, physics_dt, noise_level)

    def add_sensors(self, spec: mujoco.MjSpec) -> None:
        """Nothing: the forces are measured anyway."""

    def reset(self, rng: np.random.Generator) -> None:
        self.synthesis.reset(rng)

    def step(self, model: mujoco.MjModel, moment: Moment) -> dict[str, np.ndarray]:
        forces = moment.forces if (self._loudness == 1.0).all() else moment.forces * self._loudness
        return self.synthesis.step(forces, moment.joint_speed)


contact_sound = ForceEars


class MaterialEars:
    """Ears for things that are made of something else from episode to episode: a synthesiser for each choice of materials.

    Args:
        make: `make(pairs, *rest)` makes a synthesiser. What it measures must not depend on materials.
        pairs: What can be heard, of the usual materials.
        rest: Its other arguments.

    Attributes:
        background_rms: Of the task's own noise and hum, relative to full scale: what the synthesiser says, or version 0's.
    """

    def __init__(self, make: Callable[..., Ears], pairs: list[HeardPair], *rest: Any):
        self.background_rms: float = getattr(make, "background_rms", USUAL_RMS)
        self._make, self._pairs, self._rest = make, pairs, rest
        self._made: dict[tuple[tuple[str, str], ...], Ears] = {}
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
            self._made[key] = self._make([_made_of(pair, materials) for pair in self._pairs], *self._rest)
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
