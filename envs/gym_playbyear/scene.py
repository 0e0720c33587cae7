"""The whole MuJoCo model of a task, as MJCF."""

from gym_playbyear.arena import contact_sensor_xml, cube_xml, table_xml
from gym_playbyear.arm import ARM_DEFAULT_XML, PHYSICS_TIMESTEP, arm_actuator_xml, arm_body_xml
from gym_playbyear.variant import Variant


def model_xml(variant: Variant, bodies: str, pairs: tuple[tuple[str, str], ...], picture_size: int) -> str:
    """The arm at its table, with a task's own bodies and the cube.

    Args:
        variant: The task's numbers.
        bodies: The task's own bodies, as MJCF.
        pairs: Names of bodies whose contacts are measured.
        picture_size: Height and width of the largest picture [pixels].
    """
    return f"""
<mujoco model="playbyear">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{PHYSICS_TIMESTEP}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <visual>
    <global offwidth="{picture_size}" offheight="{picture_size}"/>
    <quality offsamples="0" numslices="10" numstacks="5"/>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.45 0.45 0.45" specular="0 0 0"/>
    <map znear="0.02" zfar="20"/>
  </visual>
  <statistic extent="1.5" center="0 0 0.9"/>
  <default>{ARM_DEFAULT_XML}</default>
  <asset><texture type="skybox" builtin="gradient" rgb1="0.85 0.88 0.92" rgb2="0.45 0.5 0.56" width="32" height="192"/></asset>
  <worldbody>{arm_body_xml(variant.arm)}{table_xml()}{bodies}
    {cube_xml(variant.cube_density, variant.cube_friction)}
  </worldbody>
  {arm_actuator_xml(variant.arm)}{contact_sensor_xml(pairs)}
</mujoco>"""
