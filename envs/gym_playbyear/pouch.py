"""A closed pouch with loose pieces in it: what is in it can be told by its rattle alone."""

from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.looks_props import soft_pouch
from gym_playbyear.task import Prop

POUCH = "pouch"
HALF_SIZE = (0.024, 0.018, 0.025)  # m
CONTENTS = ("screws", "peanuts")
N_PIECES = 3
PIECES = tuple(f"piece{number}" for number in range(N_PIECES))
_WALL = 0.004  # m, thickness: more than a piece covers in a physics step
_POUCH_MASS, _PIECE_MASS = 0.04, 0.015  # kg
_PIECE_RADIUS, _PIECE_HALF_LENGTH = 0.0045, 0.007  # m
_COLOUR, _SEAM = "0.15 0.35 0.65 1", "0.9 0.9 0.85 1"
_BOUNCE = 'priority="1" solref="0.02 0.25"'  # a piece comes back from the wall with two fifths of its speed


def pouch() -> Prop:
    """The closed pouch: stiff walls, a light seam on top."""
    walls = ""
    for axis in range(3):
        for sign in (1, -1):
            position, size = np.zeros(3), np.array(HALF_SIZE)
            position[axis], size[axis] = sign * (HALF_SIZE[axis] - _WALL / 2), _WALL / 2
            walls += f"""<geom type="box" size="{_numbers(size)}" pos="{_numbers(position)}" mass="{_POUCH_MASS / 6}"
                friction="1 0.01 0.0005" condim="4" rgba="{_COLOUR}"/>"""
    seam = f"{HALF_SIZE[0]} 0.003 0.002"
    return Prop(
        POUCH,
        f"""<body name="{POUCH}"><freejoint name="{POUCH}"/>{walls}
        <geom type="box" size="{seam}" pos="0 0 {HALF_SIZE[2]}" mass="0" contype="0" conaffinity="0" rgba="{_SEAM}"/>
        </body>""",
        material=POUCH,
        loose=True,
        looks=soft_pouch(HALF_SIZE),
    )


def pieces() -> tuple[Prop, ...]:
    """The pieces in it. They are the same whatever they are made of: only their sound differs."""
    half = _PIECE_HALF_LENGTH
    return tuple(
        Prop(
            name,
            f"""<body name="{name}"><freejoint name="{name}"/>
            <geom type="capsule" fromto="{-half} 0 0 {half} 0 0" size="{_PIECE_RADIUS}" mass="{_PIECE_MASS}"
                condim="6" friction="0.3 0.005 0.001" {_BOUNCE} rgba="0.5 0.5 0.5 1"/></body>""",
            material=CONTENTS[0],
            loose=True,
            loudness=60.0,
            hidden=True,
            inside=POUCH,
        )
        for name in PIECES
    )


def put_pouch(env: Any, x: float, y: float, yaw: float) -> None:
    """Stands the pouch on the table, with its pieces in it: two beside each other, one on top."""
    middle = np.array([x, y, TABLE_TOP + HALF_SIZE[2]])
    env.put(POUCH, middle, yaw)
    across = np.array([-np.sin(yaw), np.cos(yaw), 0])
    for number, name in enumerate(PIECES):
        side, layer = (-1, 1)[number % 2], number // 2
        env.put(name, middle + 0.006 * side * across + [0, 0, -0.015 + 0.012 * layer], yaw)


def _numbers(vector) -> str:
    return " ".join(f"{number:.6g}" for number in vector)
