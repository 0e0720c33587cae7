"""The table, its light and camera, and the boxes that tasks put on it, as MJCF; and which of their contacts are heard."""

import numpy as np

TABLE_TOP = 0.80  # m, world frame
TABLE_HALF_SIZE = 0.40  # m
CUBE_HALF_SIZE = 0.02  # m
FINGERS = ("left_finger", "right_finger")
_SCENE = 'contype="0" conaffinity="3"'

FRONT_CAMERA_XML = '<camera name="front" pos="0.5 0 1.35" quat="0.653 0.271 0.271 0.653" fovy="45"/>'
PEOPLE_CAMERA_XML = '<camera name="people" pos="-0.15 -1.15 1.45" xyaxes="0.98 -0.2 0 0.12 0.5 0.85" fovy="38"/>'


def table_xml() -> str:
    """A table of 0.8 x 0.8 m on a floor."""
    return f"""
    <light pos="0.3 -0.2 2.4" dir="-0.1 0.1 -1" diffuse="0.6 0.6 0.6" castshadow="false"/>
    {FRONT_CAMERA_XML}{PEOPLE_CAMERA_XML}
    <body name="table">
      <geom name="table" type="box" size="{TABLE_HALF_SIZE} {TABLE_HALF_SIZE} 0.02" pos="0 0 {TABLE_TOP - 0.02}" {_SCENE}
            friction="0.4 0.005 0.0001" rgba="0.72 0.60 0.45 1"/>
    </body>"""


def box_xml(name: str, half_size, position, rgba: str, *, solid: bool = True) -> str:
    """A fixed box of its own body; `solid=False` is for what is only seen."""
    contact = _SCENE if solid else 'contype="0" conaffinity="0"'
    size, pos = " ".join(map(str, half_size)), " ".join(map(str, position))
    return (
        f'<body name="{name}" pos="{pos}"><geom name="{name}" type="box" size="{size}" {contact} rgba="{rgba}"/></body>'
    )


def tray_xml(name: str, half_width: float, half_height: float) -> str:
    """An open tray: a floor and four walls. A task places it at the start of each episode."""
    thickness = 0.004
    walls = ""
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        position, size = np.zeros(3), np.full(3, half_width)
        position[axis], position[2] = sign * (half_width - thickness), half_height
        size[axis], size[2] = thickness, half_height
        walls += (
            f'<geom type="box" size="{size[0]} {size[1]} {size[2]}" pos="{position[0]} {position[1]} {position[2]}" '
            f'{_SCENE} rgba="0.2 0.55 0.3 1"/>'
        )
    return f"""
    <body name="{name}">
      <geom type="box" size="{half_width} {half_width} 0.002" pos="0 0 0.002" {_SCENE} rgba="0.25 0.65 0.35 1"/>{walls}
    </body>"""


def cube_xml(density: float, friction: float) -> str:
    """The red cube, free to move. It follows the arm in the model, so that the arm's joints come first in qpos."""
    return f"""
    <body name="cube" pos="0 0 {TABLE_TOP + CUBE_HALF_SIZE}">
      <freejoint name="cube"/>
      <geom name="cube" type="box" size="{CUBE_HALF_SIZE} {CUBE_HALF_SIZE} {CUBE_HALF_SIZE}" density="{density}"
            friction="{friction} 0.01 0.0005" contype="2" conaffinity="1" condim="4" rgba="0.85 0.1 0.1 1"/>
    </body>"""


def contact_pairs(scene_bodies: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """All pairs of bodies whose contact makes sound: gripper and cube with each other and with everything fixed."""
    pairs = [("gripper", "cube")]
    for body in scene_bodies:
        pairs += [("gripper", body), ("cube", body)]
    return tuple(pairs)


def contact_sensor_xml(pairs: tuple[tuple[str, str], ...]) -> str:
    """Net-force sensors (3 numbers each, N, world frame), then the cube's net force and torque (6 numbers).

    The first pair, gripper and cube, has one sensor per finger, since the forces of a squeeze cancel in their sum; every
    other pair has one.
    """
    sides = {"gripper": 'subtree{}="link5"', **{finger: f'body{{}}="{finger}"' for finger in FINGERS}}

    def sensor(a: str, b: str) -> str:
        first, second = (sides.get(body, f'body{{}}="{body}"').format(i) for i, body in ((1, a), (2, b)))
        return f'<contact name="{a}-{b}" {first} {second} num="1" data="force" reduce="netforce"/>'

    sensors = [sensor(finger, "cube") for finger in FINGERS] + [sensor(a, b) for a, b in pairs[1:]]
    cube = '<contact name="cube" body1="cube" num="1" data="force torque" reduce="netforce"/>'
    return f"<sensor>{''.join(sensors)}{cube}</sensor>"


def pair_forces(sensors: np.ndarray, n_pairs: int) -> np.ndarray:
    """Magnitudes of the pairs' contact forces, (T, n_pairs) [N], from sensor readings (T, n_sensors)."""
    vectors = sensors[:, : 3 * (n_pairs + 1)].reshape(len(sensors), n_pairs + 1, 3)
    magnitudes = np.sqrt(np.einsum("tpc,tpc->tp", vectors, vectors))
    magnitudes[:, 1] += magnitudes[:, 0]
    return magnitudes[:, 1:]
