"""From a task's parts to one MuJoCo model."""

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

from gym_playbyear.task import Camera, Prop, Task

PEOPLE_CAMERA = Camera("people", 'pos="-0.15 -1.15 1.45" xyaxes="0.98 -0.2 0 0.12 0.5 0.85" fovy="38"')
_FIXED_BITS, _LOOSE_BITS = (0, 3), (2, 3)  # contype and conaffinity; the arm's are 1 and 0
_ARM_BIT = 1
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
    <quality offsamples="0" shadowsize="0" numslices="10" numstacks="5"/>
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
