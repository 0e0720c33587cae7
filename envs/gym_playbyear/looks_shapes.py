"""Shapes for the eye, made in code: convex shells around rounded cylinders and boxes. Nothing of them touches anything."""

from collections.abc import Iterable

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

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
        finish: Name of a material (`gym_playbyear.looks_finishes`).
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
