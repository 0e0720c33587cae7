"""From a task's parts to one MuJoCo model: what attaches, which contacts are measured, and how their forces are read."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations

import mujoco
import numpy as np

from gym_playbyear.ears import HeardPair
from gym_playbyear.task import Camera, Prop, Task

GRIPPER = "gripper"
PEOPLE_CAMERA = Camera("people", 'pos="-0.15 -1.15 1.45" xyaxes="0.98 -0.2 0 0.12 0.5 0.85" fovy="38"')
_FIXED_BITS, _LOOSE_BITS = (0, 3), (2, 3)  # contype and conaffinity; the arm's are 1 and 0
_ARM_BIT = 1
_FORCE, _TORQUE, _NET_FORCE = 1 << 1, 1 << 2, 3  # of a contact sensor: what it measures, `reduce="netforce"`
_HEAD = '<compiler angle="radian" autolimits="true"/>'


def compose(task: Task, picture_size: int, hidden_object: bool = True) -> mujoco.MjSpec:
    """Puts the parts of a task together, without sensors.

    Args:
        task: The task.
        picture_size: Height and width of the largest picture [pixels].
        hidden_object: False: the hand passes through what is hidden, and nobody sees it. All else moves as if it were there.
    """
    cameras = "".join(
        f'<camera name="{camera.name}" {camera.attributes}/>' for camera in (*task.cameras, PEOPLE_CAMERA)
    )
    spec = mujoco.MjSpec.from_string(f"""
<mujoco model="playbyear">
  {_HEAD}
  <option timestep="{task.physics_dt}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <visual>
    <global offwidth="{picture_size}" offheight="{picture_size}"/>
    <quality offsamples="0" numslices="10" numstacks="5"/>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.45 0.45 0.45" specular="0 0 0"/>
    <map znear="0.02" zfar="20"/>
  </visual>
  <statistic extent="1.5" center="0 0 0.9"/>
  <asset><texture type="skybox" builtin="gradient" rgb1="0.85 0.88 0.92" rgb2="0.45 0.5 0.56" width="32" height="192"/></asset>
  <worldbody>{cameras}</worldbody>
</mujoco>""")
    still = [prop for prop in (task.arena, *task.props) if not prop.loose]
    moving = [prop for prop in task.props if prop.loose]
    # The arm first, so that its joints come first in qpos; then what stands still.
    parts = [task.arm.spec(), *(_of_prop(prop, hidden_object or not prop.hidden) for prop in (*still, *moving))]
    with _unprefixed():
        for part in parts:
            spec.attach(part, prefix="", frame=spec.worldbody.add_frame())
        return spec.copy()  # without what was warned of


@contextmanager
def _unprefixed() -> Iterator[None]:
    """Parts keep their names, by which scripts, contacts and sensors go. MuJoCo warns that such a model may not be saved
    correctly, which nobody does."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _from_mjcf(text: str) -> mujoco.MjSpec:
    if not text.lstrip().startswith("<mujoco"):
        text = f"<mujoco>{_HEAD}<worldbody>{text}</worldbody></mujoco>"
    return mujoco.MjSpec.from_string(text)


def _of_prop(prop: Prop, is_there: bool) -> mujoco.MjSpec:
    assert isinstance(prop.spec, str)
    spec = _from_mjcf(prop.spec)
    if spec.body(prop.name) is None:
        raise ValueError(f"Prop {prop.name!r} has no body of that name: name its outermost body so.")
    if prop.loose and spec.joint(prop.name) is None:
        raise ValueError(f'Prop {prop.name!r} is loose and has no <freejoint name="{prop.name}"/>.')
    for geom in spec.geoms:
        if (geom.contype, geom.conaffinity) == (1, 1):
            geom.contype, geom.conaffinity = _LOOSE_BITS if prop.loose else _FIXED_BITS
        if not is_there:
            geom.conaffinity &= ~_ARM_BIT
            geom.rgba[3] = 0.0
    return spec


def bending_joints(model: mujoco.MjModel, task: Task) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of each prop that crackles when it bends: where its joints' velocities stand, and their factors; both (n_joints,)."""
    return {
        prop.name: (
            np.array([model.joint(joint).dofadr[0] for joint, _ in prop.bends]),
            np.array([factor for _, factor in prop.bends]),
        )
        for prop in (task.arena, *task.props)
        if prop.bends
    }


class Contacts:
    """The contacts that are measured in a task: their sensors, and the forces of each.

    The hand and a loose thing have one sensor for each part of the hand, since the forces of a squeeze cancel in their sum;
    every other pair has one.

    Attributes:
        pairs: Two names each: the hand ("gripper") and everything loose with each other and with all that stands still, except
            what is shut in with what is outside. A thing whose parts are heard has a pair with itself.
    """

    def __init__(self, task: Task):
        self._arm = task.arm
        props = [prop for prop in (task.arena, *task.props) if prop.material is not None]
        self._props = {prop.name: prop for prop in props}
        loose = [prop.name for prop in props if prop.loose]
        still = [prop.name for prop in props if not prop.loose]
        pairs = [(GRIPPER, name) for name in loose] + list(combinations(loose, 2))
        pairs += [(prop.name, prop.name) for prop in props if prop.jingles]
        for name in still:
            pairs += [(other, name) for other in (GRIPPER, *loose)]
        self.pairs: tuple[tuple[str, str], ...] = tuple(pair for pair in pairs if self._can_touch(*pair))
        self._loose = frozenset(loose)
        n_parts = [len(self._arm.touching) if self._is_grip(pair) else 1 for pair in self.pairs]
        self._first_part = np.concatenate([[0], np.cumsum(n_parts)[:-1]]).astype(int)
        self._n_parts = int(sum(n_parts))

    def heard(self) -> list[HeardPair]:
        """The pairs as a synthesiser wants them."""
        return [
            HeardPair(
                (a, b),
                (self._material(a), self._material(b)),
                (self._loudness(a), self._loudness(b)),
                self._loose & {a, b},
                self._sensed(a, b),
            )
            for a, b in self.pairs
        ]

    def add_sensors(self, spec: mujoco.MjSpec, felt: str | None) -> None:
        """Adds the sensors; those of `felt`, its net force and torque, come last."""
        for a, b in self.pairs:
            for part in self._sensed(a, b):
                _add_sensor(spec, f"force:{part[0]}-{b}", part, (b, True))
        if felt is not None:
            _add_sensor(spec, f"force:{felt}", (felt, True), None)

    def magnitudes(self, sensordata: np.ndarray) -> np.ndarray:
        """Force of each pair (T, n_pairs) [N], from sensor readings (T, nsensordata)."""
        vectors = sensordata[:, : 3 * self._n_parts].reshape(len(sensordata), self._n_parts, 3)
        return np.add.reduceat(np.sqrt(np.einsum("tpc,tpc->tp", vectors, vectors)), self._first_part, axis=1)

    def hand_forces(self, sensordata: np.ndarray, name: str) -> np.ndarray:
        """Forces between the parts of the hand and a loose thing (T, parts, 3) [N, world axes].

        Raises:
            ValueError: There is no such thing, or the hand's contact with it is measured as a whole.
        """
        if name not in self._loose:
            raise ValueError(
                f"The parts of the hand are told apart on loose things with a material alone ({', '.join(sorted(self._loose))}"
                f"), {name!r} is none: `contact_forces` has what the whole hand does to it."
            )
        first = 3 * int(self._first_part[self.pairs.index((GRIPPER, name))])
        n_parts = len(self._arm.touching)
        return sensordata[:, first : first + 3 * n_parts].reshape(len(sensordata), n_parts, 3)

    def felt(self, sensordata: np.ndarray) -> np.ndarray:
        """Net force [N] and torque [Nm] on the thing that is felt (T, 6)."""
        first = 3 * self._n_parts
        return sensordata[:, first : first + 6]

    def _can_touch(self, a: str, b: str) -> bool:
        rooms = [self._props[name].inside if name in self._props else None for name in (a, b)]
        return rooms[0] == rooms[1] or rooms == [b, None] or rooms == [None, a]

    def _is_grip(self, pair: tuple[str, str]) -> bool:
        return pair[0] == GRIPPER and pair[1] in self._loose

    def _sensed(self, a: str, b: str) -> tuple[tuple[str, bool], ...]:
        """The bodies that stand for the first of a pair; True: with all that hangs on them."""
        if self._is_grip((a, b)):
            return tuple((part, False) for part in self._arm.touching)
        return ((self._arm.root, True),) if a == GRIPPER else ((a, True),)

    def _material(self, name: str) -> str:
        material = GRIPPER if name == GRIPPER else self._props[name].material
        assert material is not None
        return material

    def _loudness(self, name: str) -> float:
        return 1.0 if name == GRIPPER else self._props[name].loudness


def _add_sensor(spec: mujoco.MjSpec, name: str, first: tuple[str, bool], second: tuple[str, bool] | None) -> None:
    """A net contact force [N, world axes] between two bodies, or (with the torque) on one; True: with all that hangs on it."""
    kinds = {False: mujoco.mjtObj.mjOBJ_BODY, True: mujoco.mjtObj.mjOBJ_XBODY}
    data = _FORCE
    if second is None:
        data |= _TORQUE
    sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT, name=name, objtype=kinds[first[1]], objname=first[0])
    if second is not None:
        sensor.reftype, sensor.refname = kinds[second[1]], second[0]
    sensor.intprm = [data, _NET_FORCE, 1]
