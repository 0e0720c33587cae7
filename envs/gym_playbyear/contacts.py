"""Which contacts are measured, their sensors, and one reading of them per control step for rules, scripts and sound.

`add_sensors` puts sensors into a model, one `mujoco.rollout` call fills their readings for all physics steps of a control step,
and a `ContactReader` makes forces, speeds and places of them, without a loop over physics steps. A contact has two sensors: the
net force, and place and normal of its strongest point. Velocities are those of the two bodies at that point.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import mujoco
import numpy as np

from gym_playbyear.task import Task

GRIPPER = "gripper"
_MAX_FORCE, _NET_FORCE = 2, 3  # MuJoCo's ways to make one reading of many contact points ("reduce")
_FORCE, _TORQUE, _POSITION, _NORMAL = (
    1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FORCE", "TORQUE", "POS", "NORMAL")
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
_FELT_BY_A_BLOW = 0.5  # kg: within a contact's millisecond a blow is felt by the hand, not by the whole arm


@dataclass(frozen=True)
class ContactPair:
    """Two bodies whose contact is measured and heard.

    Attributes:
        bodies: Names of two bodies of the model.
        materials: Of what they are, names in `sound.materials.ALL_MATERIALS`.
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


class TaskContacts:
    """The contacts that are measured in a task.

    The hand and a loose thing have one pair of bodies for each part of the hand, since the forces of a squeeze cancel in their
    sum; all other things have one.

    Attributes:
        names: Two names each: the hand ("gripper") and everything loose with each other and with all that stands still, except
            what is shut in with what is outside. A thing whose parts are heard has a pair with itself.
        pairs: The pairs of bodies in the same order, and last the fingers, which click when they meet.
    """

    def __init__(self, task: Task):
        self._arm = task.arm
        props = [prop for prop in (task.arena, *task.props) if prop.material is not None]
        self._props = {prop.name: prop for prop in props}
        self._loose = [prop.name for prop in props if prop.loose]
        names = [(GRIPPER, name) for name in self._loose] + list(combinations(self._loose, 2))
        names += [(prop.name, prop.name) for prop in props if prop.jingles]
        for prop in props:
            if not prop.loose:
                names += [(other, prop.name) for other in (GRIPPER, *self._loose)]
        self.names: tuple[tuple[str, str], ...] = tuple(pair for pair in names if self._can_touch(*pair))
        of_names = [self._pairs_of(a, b) for a, b in self.names]
        self.pairs = [pair for pairs in of_names for pair in pairs]
        counts = [len(pairs) for pairs in of_names]
        self._first = np.cumsum([0, *counts])[:-1].astype(int)  # pair of bodies of each pair of names
        if any("left_finger" in pair.bodies for pair in self.pairs):
            fingers = ("left_finger", "right_finger")
            self.pairs.append(ContactPair(fingers, (GRIPPER, GRIPPER), stop="left_finger"))

    def magnitudes(self, forces: np.ndarray) -> np.ndarray:
        """Force of each pair of names (T, n) [N], from those of `ContactReader.forces`."""
        return np.add.reduceat(_length(forces), self._first, axis=1)

    def hand_forces(self, forces: np.ndarray, name: str) -> np.ndarray:
        """Forces between the parts of the hand (`Panda.touching`) and a loose thing (T, parts, 3) [N, world axes].

        Raises:
            ValueError: There is no such thing, or the hand's contact with it is measured as a whole.
        """
        if name not in self._loose:
            raise ValueError(
                f"Only loose bodies with a material have forces for each part of the hand ({', '.join(self._loose)}), and "
                f"{name!r} is not one: `contact_forces` has those of the whole hand."
            )
        first = int(self._first[self.names.index((GRIPPER, name))])
        return forces[:, :, first : first + len(self._arm.touching)].transpose(0, 2, 1)

    def _pairs_of(self, a: str, b: str) -> list[ContactPair]:
        """The pairs of bodies that stand for two things."""
        bodies = [(self._arm.root, True)] if a == GRIPPER else [(a, True)]
        if a == GRIPPER and b in self._loose:
            bodies = [(part, False) for part in self._arm.touching]
        materials, loudness = (self._material(a), self._material(b)), (self._loudness(a), self._loudness(b))
        return [ContactPair((body, b), materials, loudness, (with_all, True)) for body, with_all in bodies]

    def _can_touch(self, a: str, b: str) -> bool:
        rooms = [self._props[name].inside if name in self._props else None for name in (a, b)]
        return rooms[0] == rooms[1] or rooms == [b, None] or rooms == [None, a]

    def _material(self, name: str) -> str:
        material = GRIPPER if name == GRIPPER else self._props[name].material
        assert material is not None
        return material

    def _loudness(self, name: str) -> float:
        return 1.0 if name == GRIPPER else self._props[name].loudness


def add_sensors(spec: mujoco.MjSpec, pairs: Sequence[ContactPair], heard: bool = True) -> None:
    """Adds what `ContactReader` reads. Call it once, before `spec.compile()`; all names begin with "contact:".

    Args:
        spec: The model.
        pairs: Of bodies.
        heard: Whether speeds and places are measured, too, for `ContactReader.read`.
    """
    for body in dict.fromkeys(body for pair in pairs for body in pair.bodies):
        for name, kind in _FRAME_SENSORS.items() if heard else ():
            spec.add_sensor(name=_sensor(name, body), type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body)
    for pair in pairs:
        if not pair.stop:
            _add_contact(spec, pair, heard)
        elif heard:
            for name, kind in _STOP_SENSORS.items():
                joint = {"objtype": mujoco.mjtObj.mjOBJ_JOINT, "objname": pair.stop}
                spec.add_sensor(name=_sensor(name, pair.name), type=kind, **joint)


def add_net_force(spec: mujoco.MjSpec, body: str) -> str:
    """Adds a sensor of the net contact force [N] and torque [Nm] on a body with all that hangs on it, 6 numbers. Its name."""
    name = _sensor("net", body)
    sensor = spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_CONTACT, name=name, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body
    )
    sensor.intprm[:3] = (_FORCE | _TORQUE, _NET_FORCE, 1)
    return name


class ContactReader:
    """Decodes the sensors of `add_sensors`. It keeps indices only, so that it can be copied and pickled.

    Args:
        model: Compiled from the `MjSpec` that got the sensors.
        pairs: As given to `add_sensors`; their order is that of the columns.
        heard: As given to `add_sensors`.
    """

    def __init__(self, model: mujoco.MjModel, pairs: Sequence[ContactPair], heard: bool = True) -> None:
        self.pairs = tuple(pairs)
        self._touching = np.array([i for i, pair in enumerate(pairs) if not pair.stop], int)
        touching = [self.pairs[i] for i in self._touching]
        self._force = _columns(model, [_sensor("force", pair.name) for pair in touching])
        if not heard:
            return
        self._point = _columns(model, [_sensor("point", pair.name) for pair in touching])
        # (3 numbers, pairs, [first, second body])
        self._frames = {
            name: np.stack([_columns(model, [_sensor(name, pair.bodies[i]) for pair in touching]) for i in (0, 1)], -1)
            for name in _FRAME_SENSORS
        }
        self._stops = [(i, _stop_columns(model, pair)) for i, pair in enumerate(pairs) if pair.stop]
        self._mass = np.array([_reduced_mass(model, pair) for pair in pairs])

    def forces(self, sensordata: np.ndarray) -> np.ndarray:
        """Net forces on the second body of each pair that has no stop (n_substeps, 3, n_touching) [N, world axes].

        Args:
            sensordata: (n_substeps, model.nsensordata), as `mujoco.rollout` gives it.
        """
        return sensordata[:, self._force]

    def read(self, sensordata: np.ndarray, forces: np.ndarray | None = None) -> Contacts:
        """The contacts of a control step; `forces` of the same, where they are at hand."""
        steps, n_pairs = len(sensordata), len(self.pairs)
        scalars = np.zeros((4, steps, n_pairs))
        position = np.zeros((steps, n_pairs, 3))
        force = self.forces(sensordata) if forces is None else forces
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


def _add_contact(spec: mujoco.MjSpec, pair: ContactPair, heard: bool) -> None:
    kinds = [mujoco.mjtObj.mjOBJ_XBODY if subtree else mujoco.mjtObj.mjOBJ_BODY for subtree in pair.subtrees]
    sensors = [("force", _FORCE, _NET_FORCE), ("point", _POSITION | _NORMAL, _MAX_FORCE)]
    for name, fields, reduce in sensors if heard else sensors[:1]:
        sensor = spec.add_sensor(name=_sensor(name, pair.name), type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.reftype = kinds
        sensor.objname, sensor.refname = pair.bodies
        sensor.intprm[:3] = (fields, reduce, 1)


def _stop_columns(model: mujoco.MjModel, pair: ContactPair) -> tuple[np.ndarray, np.ndarray, float]:
    """Columns of force, speed and joint; of the place; and the middle of the joint's range."""
    readings = [model.sensor(_sensor(name, pair.name)).adr[0] for name in _STOP_SENSORS]
    place = _columns(model, [_sensor("position", pair.bodies[0])])[:, 0]
    return np.array(readings), place, float(model.joint(pair.stop).range.mean())


def _reduced_mass(model: mujoco.MjModel, pair: ContactPair) -> float:
    """MuJoCo's own estimate of what resists a push on a body, and no more than what feels a blow in time [kg]."""
    inverse = sum(model.body_invweight0[model.body(body).id, 0] for body in pair.bodies)
    return float(1.0 / (inverse + 1.0 / _FELT_BY_A_BLOW))


def _columns(model: mujoco.MjModel, sensors: list[str]) -> np.ndarray:
    """Where the readings of some sensors of one size are, (size, n_sensors)."""
    sensor = [model.sensor(name) for name in sensors]
    size = int(sensor[0].dim[0]) if sensor else 3
    return np.array([s.adr[0] + np.arange(size) for s in sensor], int).reshape(-1, size).T


def _sensor(what: str, of: str) -> str:
    return f"contact:{what}:{of}"


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("tcp,tcp->tp", a, b)


def _length(a: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("tcp,tcp->tp", a, a))
