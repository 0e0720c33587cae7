"""The table, and boxes and trays to put on it."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gym_playbyear.registry import OptionError
from gym_playbyear.task import Camera, Prop
from gym_playbyear.visuals import table_on_legs

TABLE_TOP = 0.80  # m, world frame
TABLE_HALF_SIZE = 0.40  # m
CUBE_HALF_SIZE = 0.02  # m
MAX_SHOVE = 0.022  # m: how far a hidden cube may be shoved along the table before the attempt has failed
LINE_X = 0.0  # m: of the line along the table on which hidden things lie
WALL_COLOUR = "0.55 0.57 0.62 1"
_SCENE = 'contype="0" conaffinity="3"'

FRONT_CAMERA = Camera("front", 'pos="0.5 0 1.35" quat="0.653 0.271 0.271 0.653" fovy="45"')

TABLE = Prop(
    "table",
    f"""<body name="table">
      <light pos="0.3 -0.2 2.4" dir="-0.1 0.1 -1" diffuse="0.6 0.6 0.6" castshadow="false"/>
      <geom name="table" type="box" size="{TABLE_HALF_SIZE} {TABLE_HALF_SIZE} 0.02" pos="0 0 {TABLE_TOP - 0.02}" {_SCENE}
            friction="0.4 0.005 0.0001" rgba="0.72 0.60 0.45 1"/>
    </body>""",
    material="table",
    visuals=table_on_legs,
)
"""A table of 0.8 x 0.8 m, and the light above it."""


def on_table(option: str, place: Sequence[float]) -> tuple[float, float]:
    """Where an option of `reset` wants a thing, (x, y) [m, world].

    Raises:
        OptionError: It is not on the table.
    """
    where = np.asarray(place, dtype=float)
    if where.shape != (2,) or not (np.abs(where) < TABLE_HALF_SIZE).all():
        wanted = f"give x and y on the table, nearer than {TABLE_HALF_SIZE} m to its middle"
        raise OptionError(f"reset(options) {option}", place, wanted)
    return float(where[0]), float(where[1])


def box(name: str, half_size, position, rgba: str, *, material: str | None = None, **traits: Any) -> Prop:
    """A fixed box. Without a material it is only seen.

    Args:
        name: Its name.
        half_size: Half its edges (3,) [m].
        position: Its centre (3,) [m, world].
        rgba: Colour, four numbers in [0, 1].
        material: What it sounds like.
        traits: More of `Prop`.
    """
    contact = _SCENE if material is not None else 'contype="0" conaffinity="0"'
    size, pos = " ".join(map(str, half_size)), " ".join(map(str, position))
    geom = f'<geom name="{name}" type="box" size="{size}" {contact} rgba="{rgba}"/>'
    return Prop(name, f'<body name="{name}" pos="{pos}">{geom}</body>', material=material, **traits)


def tray(name: str, half_width: float, half_height: float, *, material: str = "tray") -> Prop:
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
    return Prop(
        name,
        f"""<body name="{name}">
      <geom type="box" size="{half_width} {half_width} 0.002" pos="0 0 0.002" {_SCENE} rgba="0.25 0.65 0.35 1"/>{walls}
    </body>""",
        material=material,
    )


def loose_box(
    name: str, half_size, *, density: float, friction: float, rgba: str, material: str, **traits: Any
) -> Prop:
    """A box that moves freely; a task places it at the start of each episode.

    Args:
        name: Its name.
        half_size: Half its edges (3,) [m].
        density: [kg/m3].
        friction: Sliding friction, on a table.
        rgba: Colour, four numbers in [0, 1].
        material: What it sounds like.
        traits: More of `Prop`.
    """
    size = " ".join(map(str, half_size))
    return Prop(
        name,
        f"""<body name="{name}" pos="0 0 {TABLE_TOP + half_size[2]}">
      <freejoint name="{name}"/>
      <geom name="{name}" type="box" size="{size}" density="{density}"
            friction="{friction} 0.01 0.0005" contype="2" conaffinity="1" condim="4" rgba="{rgba}"/>
    </body>""",
        material=material,
        loose=True,
        **traits,
    )
