"""How people see the arm: white shells around its joints, grey rings between them, a parallel gripper, a pedestal.

Outlines follow the Panda's proportions, from its published joint positions; every shell is computed here.
"""

import mujoco
import numpy as np

from gym_playbyear.looks_shapes import ball, disc, rounded_box, seen, shell

_WHITE, _GREY, _DARK, _STEEL = (0.93, 0.93, 0.92, 1), (0.35, 0.36, 0.38, 1), (0.12, 0.12, 0.13, 1), (0.6, 0.62, 0.65, 1)
_X, _Y, _Z = np.eye(3)
_BACK = (-0.0825, 0.0, 0.0)

_SHELLS: dict[str, list[list[np.ndarray]]] = {
    "link1": [
        [disc((0, 0, -0.14), _Z, 0.060, 0.050), disc((0, 0, 0), _Y, 0.062, 0.056, 0.012)],
    ],
    "link2": [
        [disc((0, 0, 0), _Z, 0.060, 0.063, 0.012), disc((0, -0.115, 0), _Y, 0.056, 0.012)],
    ],
    "link3": [
        [
            disc((0, 0, -0.14), _Z, 0.056, 0.045),
            disc((0.0825, 0, 0), _Y, 0.058, 0.052, 0.012),
            ball((0, 0, -0.03), 0.05),
        ],
    ],
    "link4": [
        [disc((0, 0, 0), _Z, 0.056, 0.060, 0.012), disc((-0.0825, 0.105, 0), _Y, 0.054, 0.015)],
    ],
    "link5": [
        [disc((0, 0, -0.225), _Z, 0.054, 0.03), disc((0, 0.025, -0.06), _Z, 0.040, 0.02, 0.012)],
        [disc((0, 0.02, -0.10), _Z, 0.040, 0.02, 0.012), disc((0, 0, 0), _Y, 0.046, 0.048, 0.012)],
    ],
    "link6": [
        [disc((0, 0, 0), _Z, 0.045, 0.054, 0.012), disc((0.088, 0.005, 0), _Y, 0.043, 0.035, 0.012)],
    ],
    "link7": [
        [disc((0, 0, 0.072), _Z, 0.041, 0.026, 0.010)],
    ],
}
_RINGS: dict[str, list[np.ndarray]] = {  # dark, at the joints
    "base": [disc((0, 0, 0.142), _Z, 0.058, 0.006, 0.002)],
    "link2": [disc((0, 0, 0), _Z, 0.045, 0.0655, 0.003), disc((0, -0.130, 0), _Y, 0.0535, 0.006, 0.002)],
    "link4": [disc((0, 0, 0), _Z, 0.042, 0.0625, 0.003), disc((-0.0825, 0.123, 0), _Y, 0.0515, 0.008, 0.002)],
    "link6": [disc((0, 0, 0), _Z, 0.033, 0.0565, 0.003), disc((0.088, -0.034, 0), _Y, 0.0385, 0.012, 0.002)],
    "link7": [disc((0, 0, 0.1005), _Z, 0.036, 0.008, 0.002)],
}
_FINGERS = {"left_finger": 1, "right_finger": -1}


def dress_arm(spec: mujoco.MjSpec, base_height: float, finger_thickness: float, finger_width: float) -> None:
    """Replaces the arm's plain shapes in a scene that only people see.

    Args:
        spec: The scene.
        base_height: Of the arm's base above the floor [m].
        finger_thickness, finger_width: Of a finger along and across the opening [m]; their faces stay where they are.
    """
    for name in ("base", *_SHELLS, "hand", *_FINGERS):
        for geom in spec.body(name).geoms:
            geom.rgba[3] = 0.0
    for name, shells in _SHELLS.items():
        for parts in shells:
            shell(spec, spec.body(name), parts, "plastic", _WHITE)
    for name, rings in _RINGS.items():
        for ring in rings:
            shell(spec, spec.body(name), [ring], "rubber", _GREY)
    _dress_base(spec, base_height)
    _dress_hand(spec)
    for name, sign in _FINGERS.items():
        _dress_finger(spec, name, sign, finger_thickness, finger_width)


def _dress_base(spec: mujoco.MjSpec, height: float) -> None:
    base = spec.body("base")
    foot = [
        disc((x, y, 0.018), _Z, 0.045, 0.018) for x, y in ((0.03, 0.045), (0.03, -0.045), (-0.10, 0.04), (-0.10, -0.04))
    ]
    shell(spec, base, [*foot, disc((0, 0, 0.10), _Z, 0.060, 0.036), ball((-0.07, 0, 0.06), 0.04)], "plastic", _WHITE)
    box = mujoco.mjtGeom.mjGEOM_BOX
    seen(base, type=box, size=(0.10, 0.10, 0.010), pos=(-0.03, 0, -0.010), material="metal", rgba=_GREY)
    half = height / 2 - 0.010
    seen(base, type=box, size=(0.065, 0.065, half), pos=(-0.05, 0, -0.020 - half), material="paint", rgba=_STEEL)


def _dress_hand(spec: mujoco.MjSpec) -> None:
    hand = spec.body("hand")
    upper = rounded_box((0, 0, 0.022), (0.030, 0.096, 0.020), 0.012)
    lower = rounded_box((0, 0, 0.045), (0.027, 0.102, 0.014), 0.010)
    shell(spec, hand, [upper, lower, disc((0, 0, 0.008), _Z, 0.038, 0.008)], "plastic", _WHITE)
    rail = (0.015, 0.085, 0.004)
    seen(hand, type=mujoco.mjtGeom.mjGEOM_BOX, size=rail, pos=(0, 0, 0.058), material="metal", rgba=_DARK)


def _dress_finger(spec: mujoco.MjSpec, name: str, sign: int, thickness: float, width: float) -> None:
    """A carriage on the hand's rail, a finger that gets slimmer, and a pad where it grips."""
    body = spec.body(name)
    half, inside = spec.geom(name).size[2], sign * thickness / 2
    shell(spec, body, [rounded_box((0, sign * 0.011, 0.008), (0.0145, 0.011, 0.008), 0.002)], "metal", _GREY)
    root = rounded_box((0, sign * 0.0105, 0.014), (width / 2, 0.0095, 0.004), 0.0015)
    taper = rounded_box((0, inside, 0.026), (width / 2, thickness / 2, 0.004), 0.001)
    shell(spec, body, [root, taper], "metal", _STEEL)
    blade = rounded_box((0, inside, 1.1 * half), (width / 2, thickness / 2, 0.9 * half), 0.001)
    shell(spec, body, [blade], "metal", _STEEL)
    pad = (width / 2 - 0.001, 0.0008, 0.011)
    where = (0, sign * 0.0003, 2 * half - 0.0125)
    seen(body, type=mujoco.mjtGeom.mjGEOM_BOX, size=pad, pos=where, material="rubber", rgba=_DARK)
