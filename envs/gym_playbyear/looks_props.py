"""Shapes for the eye of things on the table: `Prop(looks=...)`. The shapes that touch stay what they are."""

import mujoco

from gym_playbyear.looks_shapes import rounded_box, seen, shell

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_STEEL, _DARK, _WOOD = (0.55, 0.57, 0.60, 1), (0.16, 0.16, 0.17, 1), (0.80, 0.68, 0.52, 1)
_LEG, _LEG_IN = 0.022, 0.06  # m: half a leg's thickness, and how far it stands inside the table's edge
_FOOT = (0.045, 0.006)  # m: half the width and height of the foot of what stands on the table
_POST = 0.006  # m


def table_on_legs(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """A table's top, of one geom, gets legs down to the floor, and a frame under it."""
    (top,) = body.geoms
    top.rgba = _WOOD
    half, under = top.size[0] - _LEG_IN, top.pos[2] - top.size[2]
    for x in (-half, half):
        for y in (-half, half):
            size = (_LEG, _LEG, under / 2)
            seen(body, type=_BOX, size=size, pos=(x, y, under / 2), material="paint", rgba=_STEEL)
        seen(body, type=_BOX, size=(_LEG, half, 0.02), pos=(x, 0, under - 0.02), material="paint", rgba=_STEEL)


def wall_on_the_table(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """A wall of one geom that goes through the table top is seen to end there, with a foot along it."""
    (wall,) = body.geoms
    low, high = spec.geom("table").pos[2] + spec.geom("table").size[2], body.pos[2] + wall.size[2]
    wall.size = (*wall.size[:2], (high - low) / 2)
    wall.pos = (*wall.pos[:2], (high + low) / 2 - body.pos[2])
    foot = (wall.size[0] + 0.012, wall.size[1] - 0.003, 0.005)
    seen(body, type=_BOX, size=foot, pos=(0, 0, low + 0.005 - body.pos[2]), material="paint", rgba=_DARK)


def panel_on_posts(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """A panel of one geom that hangs in the air stands on two posts; a task moves it along the table only."""
    (panel,) = body.geoms
    under = -panel.size[2]
    floor = spec.geom("table").pos[2] + spec.geom("table").size[2] - body.pos[2]
    for side in (-0.6, 0.6):
        y = side * panel.size[1]
        height = (under - floor) / 2
        seen(body, type=_BOX, size=(_POST, _POST, height), pos=(0, y, floor + height), material="paint", rgba=_DARK)
        foot = (_FOOT[0], _POST * 2, _FOOT[1])
        seen(body, type=_BOX, size=foot, pos=(0, y, floor + _FOOT[1]), material="paint", rgba=_DARK)


def soft_pouch(half_size: tuple[float, float, float]):
    """Shows a closed box of walls as a stuffed pouch, no larger than it is."""
    return _Pouch(half_size)


class _Pouch:
    def __init__(self, half_size: tuple[float, float, float]):
        self.half_size = half_size

    def __call__(self, spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
        colour = list(body.geoms[0].rgba)
        for geom in body.geoms[:-1]:  # the last one is the seam
            geom.rgba[3] = 0.0
        shell(spec, body, [rounded_box((0, 0, 0), self.half_size, 0.006)], "cloth", colour)
