"""Shapes, surfaces and light of the scene that people see, made in code; the shapes that touch stay as they are."""

from collections.abc import Iterable

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from gym_playbyear.panda import FINGER_THICKNESS, FINGER_WIDTH
from gym_playbyear.scene import PEOPLE_CAMERA
from gym_playbyear.task import Task

_BOX = mujoco.mjtGeom.mjGEOM_BOX
_WHITE, _GREY, _DARK, _STEEL = (0.93, 0.93, 0.92, 1), (0.35, 0.36, 0.38, 1), (0.12, 0.12, 0.13, 1), (0.6, 0.62, 0.65, 1)
_WOOD = (0.80, 0.68, 0.52, 1)
FINISHES = {
    "matt": (0.05, 0.1),
    "floor": (0.1, 0.2),
    "paint": (0.35, 0.5),
    "plastic": (0.45, 0.6),
    "metal": (0.9, 0.8),
    "rubber": (0.1, 0.2),
}
"""Surfaces: how much they shine, and how narrowly, in [0, 1]."""
_OF_MATERIALS = {
    **dict.fromkeys(("table", "bag", "cardboard", "pouch", "cloth", "sponge"), "matt"),
    **dict.fromkeys(("keys", "screws", "tin", "glass"), "metal"),
    **dict.fromkeys(("rubber", "peanuts"), "rubber"),
    "wall": "paint",
}
_CAMERA_SHIFT = (-0.21, -0.33, 0.42)  # m, from where the plain view is taken: the arm is in the picture
_FIELD = 37.0  # degrees
_SHADOW_SIZE, _SHADOW_REACH = 512, 1.0  # pixels of the map of shadows, and half the side of what it covers [m]
_FLOOR_HALF_SIZE = 4.0  # m
_SKY = (0.93, 0.95, 0.97), (0.66, 0.72, 0.79)
_LEG, _LEG_IN = 0.022, 0.06  # m: half a leg's thickness, and how far it stands inside the table's edge
_FOOT = (0.045, 0.006)  # m: half the width and height of the foot of what stands on the table
_POST = 0.006  # m


def add_visuals(spec: mujoco.MjSpec, task: Task) -> None:
    """Gives a composed scene surfaces, light, a floor, and the shapes that arm and props have for the eye.

    Args:
        spec: From `compose`; no body is added or moved.
        task: Whose scene it is.
    """
    for name, (specular, shininess) in FINISHES.items():
        spec.add_material(name=name, specular=specular, shininess=shininess)
    for prop in (task.arena, *task.props):
        body = spec.body(prop.name)
        for geom in body.find_all("geom"):
            geom.material = _OF_MATERIALS.get(prop.material or "", "plastic")
        if prop.visuals is not None:
            prop.visuals(spec, body)
    _show_arm(spec, task.arm.base[2])
    _light(spec)
    _surround(spec)


def _light(spec: mujoco.MjSpec) -> None:
    """One lamp whose shadows show how high things are, and a soft one from the other side."""
    for light in spec.lights:
        light.active = False
    spec.worldbody.add_light(
        pos=(-0.9, -1.0, 2.9), dir=(0.42, 0.46, -0.9), diffuse=(0.62, 0.60, 0.56), specular=(0.35,) * 3, castshadow=True,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )  # fmt: skip
    spec.worldbody.add_light(
        pos=(1.5, -1.0, 2.0), dir=(-0.7, 0.4, -0.6), diffuse=(0.16, 0.17, 0.20), specular=(0.1,) * 3, castshadow=False,
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )  # fmt: skip
    visual = spec.visual
    visual.headlight.ambient, visual.headlight.diffuse = [0.38, 0.39, 0.41], [0.14, 0.14, 0.14]
    visual.quality.shadowsize = _SHADOW_SIZE
    visual.quality.numslices, visual.quality.numstacks = 24, 12
    visual.map.shadowclip = _SHADOW_REACH / spec.stat.extent


def _surround(spec: mujoco.MjSpec) -> None:
    """Floor and sky, and the place to look from."""
    half = (_FLOOR_HALF_SIZE, _FLOOR_HALF_SIZE, 0.05)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    seen(spec.worldbody, type=plane, size=half, material="floor", rgba=(0.80, 0.82, 0.84, 1))
    sky = spec.textures[0]
    sky.rgb1, sky.rgb2 = (list(colour) for colour in _SKY)
    camera = spec.camera(PEOPLE_CAMERA.name)
    camera.pos, camera.fovy = np.asarray(camera.pos) + _CAMERA_SHIFT, _FIELD


# Things on the table: `Prop(visuals=...)`


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


def soft_pouch(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """A closed box of walls is seen as a stuffed pouch, no larger than it is; its last geom is the seam."""
    *walls, _ = body.geoms
    half_size = np.max([np.abs(wall.pos) + wall.size for wall in walls], axis=0)
    colour = list(walls[0].rgba)
    for wall in walls:
        wall.rgba[3] = 0.0
    shell(spec, body, [rounded_box((0, 0, 0), half_size, 0.006)], "matt", colour)


# Shapes


_SIDES = 28  # of a circle
_BEVEL_STEPS = 3


def disc(centre, axis, radius: float, half_length: float, bevel: float = 0.006) -> np.ndarray:
    """Points on a cylinder with rounded edges (N, 3) [m].

    Args:
        centre: (3,) its middle [m].
        axis: (3,) its direction, of any length.
        radius, half_length: [m]
        bevel: Radius of its edges [m].
    """
    bevel = min(bevel, radius, half_length)
    turn = np.linspace(0.0, np.pi / 2, _BEVEL_STEPS)
    radii, heights = radius - bevel + bevel * np.cos(turn), half_length - bevel + bevel * np.sin(turn)
    angle = np.linspace(0.0, 2 * np.pi, _SIDES, endpoint=False)
    first, second, along = _frame(axis)
    circle = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second  # (sides, 3)
    rings = [r * circle + side * h * along for r, h in zip(radii, heights, strict=True) for side in (-1, 1)]
    return np.asarray(centre, float) + np.concatenate(rings)


def ball(centre, radius: float) -> np.ndarray:
    """Points on a sphere (N, 3) [m]."""
    return disc(centre, (0, 0, 1), radius, radius, radius)


def rounded_box(centre, half_size, bevel: float) -> np.ndarray:
    """Points on a box with rounded edges (N, 3) [m]: balls of radius `bevel` in its corners."""
    inner = np.asarray(half_size, float) - bevel
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * inner
    return np.concatenate([ball(np.asarray(centre) + corner, bevel) for corner in corners])


def shell(parent: mujoco.MjSpec, body: mujoco.MjsBody, points: Iterable[np.ndarray], finish: str, rgba) -> None:
    """Gives a body a convex shell that is only seen.

    Args:
        parent: Where the mesh goes.
        body: Whose frame the points are in.
        points: Arrays (N, 3) [m]; the shell is the smallest convex one around all of them.
        finish: Name of a material of `FINISHES`.
        rgba: (4,) colour.
    """
    cloud = np.concatenate(list(points))
    hull = ConvexHull(cloud, qhull_options="Qt")
    used = np.unique(hull.simplices)
    vertices, faces = cloud[used], np.searchsorted(used, hull.simplices)
    corners = vertices[faces]  # (F, 3, 3)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fc,fc->f", normal, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    name = f"shell{len(parent.meshes)}"
    parent.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel(), inertia=_SHELL)
    seen(body, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=finish, rgba=rgba)


def seen(body: mujoco.MjsBody, **geom) -> mujoco.MjsGeom:
    """A geom that weighs nothing and touches nothing."""
    return body.add_geom(contype=0, conaffinity=0, mass=0, **geom)


_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL


def _frame(axis) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two directions across an axis, and its own, each (3,) of length 1."""
    along = np.asarray(axis, float) / np.linalg.norm(axis)
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    first /= np.linalg.norm(first)
    return first, np.cross(along, first), along


# The arm: white shells around its joints, grey rings between them, a parallel gripper, a pedestal. Outlines follow the Panda's
# proportions, from its published joint positions.

_, _Y, _Z = np.eye(3)

# Of each shell: the body, and what it is drawn around.
_SHELLS = (
    ("base", [disc((-0.03, 0, 0.03), _Z, 0.075, 0.03), disc((0, 0, 0.10), _Z, 0.060, 0.036)]),
    ("link1", [disc((0, 0, -0.14), _Z, 0.060, 0.050), disc((0, 0, 0), _Y, 0.062, 0.056, 0.012)]),
    ("link2", [disc((0, 0, 0), _Z, 0.060, 0.063, 0.012), disc((0, -0.115, 0), _Y, 0.056, 0.012)]),
    ("link3", [disc((0, 0, -0.14), _Z, 0.056, 0.045), disc((0.0825, 0, 0), _Y, 0.058, 0.052, 0.012)]),
    ("link4", [disc((0, 0, 0), _Z, 0.056, 0.060, 0.012), disc((-0.0825, 0.105, 0), _Y, 0.054, 0.015)]),
    ("link5", [disc((0, 0, -0.225), _Z, 0.054, 0.03), disc((0, 0.025, -0.06), _Z, 0.040, 0.02, 0.012)]),
    ("link5", [disc((0, 0.02, -0.10), _Z, 0.040, 0.02, 0.012), disc((0, 0, 0), _Y, 0.046, 0.048, 0.012)]),
    ("link6", [disc((0, 0, 0), _Z, 0.045, 0.054, 0.012), disc((0.088, 0.005, 0), _Y, 0.043, 0.035, 0.012)]),
    ("link7", [disc((0, 0, 0.072), _Z, 0.041, 0.026, 0.010)]),
    ("hand", [rounded_box((0, 0, 0.033), (0.028, 0.100, 0.026), 0.012), disc((0, 0, 0.008), _Z, 0.038, 0.008)]),
)  # fmt: skip
_RINGS = (
    ("base", [disc((0, 0, 0.142), _Z, 0.058, 0.006, 0.002)]),
    ("link2", [disc((0, 0, 0), _Z, 0.045, 0.0655, 0.003)]),
    ("link2", [disc((0, -0.130, 0), _Y, 0.0535, 0.006, 0.002)]),
    ("link4", [disc((0, 0, 0), _Z, 0.042, 0.0625, 0.003)]),
    ("link4", [disc((-0.0825, 0.123, 0), _Y, 0.0515, 0.008, 0.002)]),
    ("link6", [disc((0, 0, 0), _Z, 0.033, 0.0565, 0.003)]),
    ("link6", [disc((0.088, -0.034, 0), _Y, 0.0385, 0.012, 0.002)]),
    ("link7", [disc((0, 0, 0.1005), _Z, 0.036, 0.008, 0.002)]),
)  # fmt: skip


def _show_arm(spec: mujoco.MjSpec, base_height: float) -> None:
    """Replaces the arm's plain shapes; its base stands so high above the floor [m]. The faces of its fingers stay."""
    for name in (*dict(_SHELLS), "left_finger", "right_finger"):
        for geom in spec.body(name).geoms:
            geom.rgba[3] = 0.0
    for shells, finish, colour in ((_SHELLS, "plastic", _WHITE), (_RINGS, "rubber", _GREY)):
        for name, parts in shells:
            shell(spec, spec.body(name), parts, finish, colour)
    base, half = spec.body("base"), base_height / 2
    seen(base, type=_BOX, size=(0.065, 0.065, half), pos=(-0.05, 0, -half), material="paint", rgba=_STEEL)
    for name, sign in (("left_finger", 1), ("right_finger", -1)):
        half, inside = spec.geom(name).size[2], sign * FINGER_THICKNESS / 2
        root = rounded_box((0, sign * 0.0105, 0.010), (FINGER_WIDTH / 2, 0.0095, 0.008), 0.0015)
        taper = rounded_box((0, inside, 0.026), (FINGER_WIDTH / 2, FINGER_THICKNESS / 2, 0.004), 0.001)
        shell(spec, spec.body(name), [root, taper], "metal", _STEEL)
        blade = rounded_box((0, inside, 1.1 * half), (FINGER_WIDTH / 2, FINGER_THICKNESS / 2, 0.9 * half), 0.001)
        shell(spec, spec.body(name), [blade], "metal", _STEEL)
