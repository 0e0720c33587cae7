"""Which bodies are heard when they touch, and what MuJoCo's sensors tell of it at every physics step.

`add_sensors` puts sensors into a model, one `mujoco.rollout` call fills their readings for all physics steps of a control step,
and a `ContactReader` makes forces, speeds and places of them, without a loop over physics steps. A contact has two sensors: the
net force, and place and normal of its strongest point. Velocities are those of the two bodies at that point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

_MAX_FORCE, _NET_FORCE = 2, 3  # MuJoCo's ways to make one reading of many contact points ("reduce")
_FORCE, _POSITION, _NORMAL = (
    1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FORCE", "POS", "NORMAL")
)
_FRAME_SENSORS = {
    "position": mujoco.mjtSensor.mjSENS_FRAMEPOS,
    "velocity": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    "rotation": mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
}
_STOP_SENSORS = {
    "force": mujoco.mjtSensor.mjSENS_JOINTLIMITFRC,
    "speed": mujoco.mjtSensor.mjSENS_JOINTLIMITVEL,
    "place": mujoco.mjtSensor.mjSENS_JOINTPOS,
}
_REACH_OF_A_BLOW = 0.5  # kg: within a contact's millisecond a blow is felt by the hand, not by the whole arm


@dataclass(frozen=True)
class SoundingPair:
    """Two bodies whose contact can be heard.

    Attributes:
        bodies: Names of two bodies of the model.
        materials: Of what they are, names in `materials_v2.MATERIALS`.
        loudness: Factor on the sound of each.
        subtrees: Whether a body stands for all that hangs on it too; its motion is then that of its root. Two fingers that
            squeeze are two pairs: in one their forces would cancel.
        stop: A joint whose lower limit is the contact, for fingers that meet without colliding. Both fingers move alike.
    """

    bodies: tuple[str, str]
    materials: tuple[str, str]
    loudness: tuple[float, float] = (1.0, 1.0)
    subtrees: tuple[bool, bool] = (False, False)
    stop: str | None = None

    @property
    def name(self) -> str:
        """Of its sensors, and for messages."""
        return "|".join(self.bodies)


@dataclass(frozen=True)
class Contacts:
    """What happened between the bodies of each pair at every physics step; zero where they do not touch.

    Attributes:
        normal_force: (n_substeps, n_pairs) [N], at least 0.
        tangential_force: (n_substeps, n_pairs) [N], at least 0.
        slip_speed: Relative speed along the surface, (n_substeps, n_pairs) [m/s].
        approach_speed: Relative speed along the normal, (n_substeps, n_pairs) [m/s], positive while they approach. In the
            first step of a contact it is the speed of the impact, whatever the physics step.
        position: Of the strongest contact point, (n_substeps, n_pairs, 3) [m, world].
        mass: Reduced mass of the two bodies, (n_pairs,) [kg].
    """

    normal_force: np.ndarray
    tangential_force: np.ndarray
    slip_speed: np.ndarray
    approach_speed: np.ndarray
    position: np.ndarray
    mass: np.ndarray


def add_sensors(spec: mujoco.MjSpec, pairs: Sequence[SoundingPair]) -> None:
    """Adds what `ContactReader` reads. Call it once, before `spec.compile()`; all names begin with "sound:".

    Raises:
        ValueError: If two pairs have the same bodies, or the model has no such body or joint.
    """
    names = [pair.name for pair in pairs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"Sounding pairs with the same bodies: {', '.join(twice)}. Give each pair of bodies once.")
    for body in dict.fromkeys(body for pair in pairs for body in pair.bodies):
        if spec.body(body) is None:
            raise ValueError(f"A sounding pair names body '{body}', which the model does not have.")
        for name, kind in _FRAME_SENSORS.items():
            spec.add_sensor(name=_sensor(name, body), type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body)
    for pair in pairs:
        _add_stop(spec, pair, pair.stop) if pair.stop else _add_contact(spec, pair)


def read_contacts(model: mujoco.MjModel, sensordata: np.ndarray, pairs: Sequence[SoundingPair]) -> Contacts:
    """`ContactReader(model, pairs).read(sensordata)`; keep the reader where speed matters."""
    return ContactReader(model, pairs).read(sensordata)


class ContactReader:
    """Decodes the sensors of `add_sensors`. It keeps indices only, so that it can be copied and pickled.

    Args:
        model: Compiled from the `MjSpec` that got the sensors.
        pairs: As given to `add_sensors`; their order is that of the columns.
    """

    def __init__(self, model: mujoco.MjModel, pairs: Sequence[SoundingPair]) -> None:
        self.pairs = tuple(pairs)
        self._touching = np.array([i for i, pair in enumerate(pairs) if not pair.stop], int)
        touching = [self.pairs[i] for i in self._touching]
        self._force = _columns(model, [_sensor("force", pair.name) for pair in touching])
        self._point = _columns(model, [_sensor("point", pair.name) for pair in touching])
        # (3 numbers, pairs, [first, second body])
        self._frames = {
            name: np.stack([_columns(model, [_sensor(name, pair.bodies[i]) for pair in touching]) for i in (0, 1)], -1)
            for name in _FRAME_SENSORS
        }
        self._stops = [(i, _stop_columns(model, pair)) for i, pair in enumerate(pairs) if pair.stop]
        self._mass = np.array([_reduced_mass(model, pair) for pair in pairs])

    def read(self, sensordata: np.ndarray) -> Contacts:
        """The contacts of `sensordata`, (n_substeps, model.nsensordata), as `mujoco.rollout` gives it."""
        steps, n_pairs = len(sensordata), len(self.pairs)
        scalars = np.zeros((4, steps, n_pairs))
        position = np.zeros((steps, n_pairs, 3))
        force = sensordata[:, self._force]  # (n_substeps, 3, n_touching)
        if force.any():
            point = sensordata[:, self._point]  # (n_substeps, 6, n_touching)
            place, normal = point[:, :3], point[:, 3:]
            velocity = self._relative_velocity(sensordata, place)
            pressing = _dot(force, normal)  # the first body's force on the second, along the normal that points there
            approaching = -_dot(velocity, normal)
            scalars[:, :, self._touching] = [
                np.maximum(pressing, 0.0),
                _length(force - pressing[:, None] * normal),
                _length(velocity + approaching[:, None] * normal),
                approaching,
            ]
            scalars *= scalars[0] > 0.0
            position[:, self._touching] = place.transpose(0, 2, 1)
        for index, (columns, place_columns, middle) in self._stops:
            pressing, speed, joint = sensordata[:, columns].T
            meeting = (pressing > 0.0) & (joint < middle)
            scalars[0, :, index] = pressing * meeting
            scalars[3, :, index] = -2.0 * speed * meeting
            position[:, index] = sensordata[:, place_columns]
        return Contacts(scalars[0], scalars[1], scalars[2], scalars[3], position, self._mass)

    def _relative_velocity(self, sensordata: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Of the second body seen from the first, at the point, (n_substeps, 3, n_touching) [m/s]."""
        origin, linear, angular = (sensordata[:, columns] for columns in self._frames.values())
        arm = place[..., None] - origin  # (n_substeps, 3, n_touching, 2)
        at_point = linear + np.stack(
            [
                angular[:, 1] * arm[:, 2] - angular[:, 2] * arm[:, 1],
                angular[:, 2] * arm[:, 0] - angular[:, 0] * arm[:, 2],
                angular[:, 0] * arm[:, 1] - angular[:, 1] * arm[:, 0],
            ],
            axis=1,
        )
        return at_point[..., 1] - at_point[..., 0]


def _add_contact(spec: mujoco.MjSpec, pair: SoundingPair) -> None:
    kinds = [mujoco.mjtObj.mjOBJ_XBODY if subtree else mujoco.mjtObj.mjOBJ_BODY for subtree in pair.subtrees]
    for name, fields, reduce in (("force", _FORCE, _NET_FORCE), ("point", _POSITION | _NORMAL, _MAX_FORCE)):
        sensor = spec.add_sensor(name=_sensor(name, pair.name), type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.reftype = kinds
        sensor.objname, sensor.refname = pair.bodies
        sensor.intprm[:3] = (fields, reduce, 1)


def _add_stop(spec: mujoco.MjSpec, pair: SoundingPair, joint: str) -> None:
    if spec.joint(joint) is None:
        raise ValueError(f"The sounding pair {pair.name} names joint '{joint}', which the model does not have.")
    for name, kind in _STOP_SENSORS.items():
        spec.add_sensor(name=_sensor(name, pair.name), type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)


def _stop_columns(model: mujoco.MjModel, pair: SoundingPair) -> tuple[np.ndarray, np.ndarray, float]:
    """Columns of force, speed and joint; of the place; and the middle of the joint's range."""
    readings = [model.sensor(_sensor(name, pair.name)).adr[0] for name in _STOP_SENSORS]
    place = _columns(model, [_sensor("position", pair.bodies[0])])[:, 0]
    return np.array(readings), place, float(model.joint(pair.stop).range.mean())


def _reduced_mass(model: mujoco.MjModel, pair: SoundingPair) -> float:
    """MuJoCo's own estimate of what resists a push on a body, and no more than what feels a blow in time [kg]."""
    inverse = sum(model.body_invweight0[model.body(body).id, 0] for body in pair.bodies)
    return float(1.0 / (inverse + 1.0 / _REACH_OF_A_BLOW))


def _columns(model: mujoco.MjModel, sensors: list[str]) -> np.ndarray:
    """Where the readings of some sensors of one size are, (size, n_sensors)."""
    sensor = [model.sensor(name) for name in sensors]
    size = int(sensor[0].dim[0]) if sensor else 3
    return np.array([s.adr[0] + np.arange(size) for s in sensor], int).reshape(-1, size).T


def _sensor(what: str, of: str) -> str:
    return f"sound:{what}:{of}"


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("tcp,tcp->tp", a, b)


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("tcp,tcp->tp", a, a))
