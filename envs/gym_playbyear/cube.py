"""What the tasks with a hidden cube share: the cube, its place, and the rules about it."""

from collections.abc import Callable
from typing import Any

import numpy as np

from gym_playbyear.arena import CUBE_HALF_SIZE, FRONT_CAMERA, TABLE, TABLE_TOP, loose_box, on_table
from gym_playbyear.arm import FINGER_FRICTION
from gym_playbyear.gates import InterventionGate
from gym_playbyear.haste import ClosedUnheard
from gym_playbyear.options import check_option
from gym_playbyear.rules import Groped, Pressed, Rule, Shoved, Solved
from gym_playbyear.task import Prop
from gym_playbyear.variant import Variant

CUBE = "cube"
CUBE_MATERIALS = ("cube", "glass", "tin", "cardboard", "rubber")
_CARRIED_HEIGHT = TABLE_TOP + CUBE_HALF_SIZE + 0.015  # m: the cube's centre is this high only when it was picked up
_RAIL_GAP, _RAIL_HEIGHT, _RAIL_THICKNESS = 0.06, 0.02, 0.01  # m
_STILL = 0.015  # m: how far a cube that is held still, or lies still, may move meanwhile


def cube(variant: Variant, material: str) -> Prop:
    """The red cube, hidden; `material` is what it sounds like."""
    check_option("cube_material", material, CUBE_MATERIALS)
    return loose_box(
        CUBE,
        (CUBE_HALF_SIZE,) * 3,
        density=variant.cube_density,
        friction=variant.cube_friction,
        rgba="0.85 0.1 0.1 1",
        material=material,
        hidden=True,
    )


def rails(lower: float, upper: float) -> Prop:
    """Two low rails beside the line of the cube, from y to y [m]: a hand comes to it from above or along them, never across."""
    half_size = f"{_RAIL_THICKNESS / 2} {(upper - lower) / 2} {_RAIL_HEIGHT / 2}"
    geoms = "".join(
        f'<geom type="box" size="{half_size}" pos="{side * (_RAIL_GAP + _RAIL_THICKNESS) / 2} 0 0" rgba="0.62 0.5 0.36 1"/>'
        for side in (-1, 1)
    )
    middle = f"0 {(lower + upper) / 2} {TABLE_TOP + _RAIL_HEIGHT / 2}"
    return Prop("rails", f'<body name="rails" pos="{middle}">{geoms}</body>', material="table")


def place_cube(env: Any, options: dict[str, Any]) -> float:
    """Puts the cube where it is drawn to be, or where `options` want it. Returns its y [m]."""
    variant: Variant = env.variant
    x, y = (env.np_random.uniform(*limits) for limits in (variant.cube_x, variant.cube_y))
    yaw = env.np_random.uniform(-variant.cube_yaw, variant.cube_yaw)
    x, y = on_table("cube_position", options.get("cube_position", (x, y)))
    env.put(CUBE, (x, y, TABLE_TOP + CUBE_HALF_SIZE), options.get("cube_yaw", yaw))
    return float(y)


def cube_task(variant: Variant, condition: Callable[[Any], bool]) -> dict[str, Any]:
    """What such tasks have in common, as arguments of `Task`: they are solved when `condition(env)` has lasted long enough."""
    ends: list[Rule] = [Shoved(CUBE, variant.max_shove, _CARRIED_HEIGHT, variant.squeeze)]
    if np.isfinite(variant.max_press):
        ends.append(Pressed(CUBE, variant.max_press, FINGER_FRICTION))
    if np.isfinite(variant.closings):
        ends.append(Groped(int(variant.closings)))
    solved = Solved(condition, CUBE, variant.hold_s, _STILL) if variant.hold_s else Solved(condition)
    return {
        "arm": variant.arm,
        "arena": TABLE,
        "cameras": (FRONT_CAMERA,),
        "success": solved,
        "ends": tuple(ends),
        "haste": ClosedUnheard(CUBE),
        "gate": InterventionGate,
        "horizon": variant.horizon,
        "sensors": variant.sensors,
        "felt": CUBE,
        "numbers": variant,
    }
