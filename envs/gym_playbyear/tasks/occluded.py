"""Occluded Grasp and Occluded Pick and Place (paper, section "Simulated Domain and Tasks"): a cube that a wall hides."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.experts.blind import BLIND_GRASPS, BlindGrasp, BlindPickPlace
from gym_playbyear.experts.occluded import GraspExpert, PickPlaceExpert
from gym_playbyear.experts.occluded_gate import InterventionGate
from gym_playbyear.panda import FINGER_FRICTION, Panda
from gym_playbyear.registry import check_option
from gym_playbyear.task import Prop, Task
from gym_playbyear.tasks.arena import (
    CUBE_HALF_SIZE,
    FRONT_CAMERA,
    MAX_SHOVE,
    TABLE,
    TABLE_TOP,
    WALL_COLOUR,
    box,
    loose_box,
    on_table,
    tray,
)
from gym_playbyear.terminations import ClosedUnheard, Groped, Pressed, Shoved, Success
from gym_playbyear.visuals import panel_on_posts, wall_on_the_table

CUBE = "cube"
CUBE_MATERIALS = ("cube", "glass", "tin", "cardboard", "rubber")
_CUBE_YAW = np.pi / 12  # rad, either way: a turned cube does not fit between the fingers
_CUBE_FRICTION = 0.4  # sliding: a cube that blocked the arm would give the contact away
_CARRIED_HEIGHT = TABLE_TOP + CUBE_HALF_SIZE + 0.015  # m: the cube's centre is this high only when it was picked up
_HOLD_SECONDS, _STILL = 0.5, 0.015  # s, m: so long a cube stays where it is wanted, and moves no further meanwhile
_SQUEEZE = 10.0  # N of both fingers from which on the cube counts as held, and not shoved
_MAX_PRESS, _CLOSINGS = 5.0, 3  # N; the how-manieth closing on nothing ends the attempt
_RAIL_GAP, _RAIL_HEIGHT, _RAIL_THICKNESS = 0.06, 0.02, 0.01  # m

_GRASP_RANGE = (-0.28, 0.28)  # m: of the cube along the wall
_PANELS = 2  # in how many parts of it the panel may show the cube
_INDICATOR_HALF_SIZE = (0.02, 0.1, 0.1)  # m
_INDICATOR_X, _INDICATOR_Z = 0.25, 0.95  # m
_LIFT_HEIGHT = 0.04  # m above the table

_PICK_PLACE_RANGE = (0.06, 0.34)  # m
_BIN_HALF_WIDTH, _BIN_WALL_HALF_HEIGHT = 0.04, 0.02  # m
BIN_Y, BIN_Y_RANGE = -0.15, 0.1  # m: the bin stands at y = -0.15 - U(0, 0.1)
PLACE_TOLERANCE = 0.025  # m
_PLACE_HEIGHT = 0.85  # m, world frame


def occluded_grasp(*, cube_material: str = "cube") -> Task:
    """
    ## Description
    A red cube lies somewhere behind a wall that hides it from the camera. A blue panel in front of the wall shows which
    half of the table's width holds the cube, not where in the half. The arm has to go behind that half, sweep until
    it hears itself touch the cube, hop over it, grasp it, lift it and hold it still. After Du et al., "Play it by Ear"
    (RSS 2022).

    ## Action Space
    `Box(-1, 1, (4,), float32)`: displacement of the end effector along x, y, z in units of 0.05 m per step, and the gripper
    (> 0 closes). The hand's orientation is fixed. 20 steps per second. After a change of the gripper command the next one is
    ignored for 2 s, as on the authors' robot. What lies beyond [-1, 1] is clipped.

    ## Observation Space
    A dictionary:
    - `pixels.front`: `(image_size, image_size, 3)` uint8, the camera in front of the wall;
    - `agent_pos`: `(7,)` float32, end effector x, y, z [m, from the robot's base], two finger positions [m], two finger
      velocities [m/s], with the noise and resolution of a real arm's encoders;
    - `audio.<microphone>`: `(sample_rate / 20,)` int16, what the microphone heard during the last step (`sound="waveform"`);
    - `contact_force`: `(6,)` float32, mean net contact force [N] and torque [Nm] on the cube (`sound="contact_force"`).

    ## Rewards
    1 at the step that solves the task, otherwise 0.

    ## Success Criteria
    The cube's centre is more than 0.04 m above the table for half a second, and moves less than 1.5 cm meanwhile.
    `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the table, within 2 cm of the same point. The cube's place and yaw are
    random; `reset(options={"cube_position": (x, y), "cube_yaw": yaw})` sets them.

    ## Episode Termination
    Terminated, and `info["end"]` says why: "success"; "shoved", when the cube was moved more than 2.2 cm before both fingers
    held it; "pressed", when the hand pressed on the cube with more than 5 N, which stops an arm for people (a squeeze between
    the fingers may be harder); "groped", when the fingers closed on nothing for the third time. Truncated, as "time", after
    `horizon` steps (250): enough for a second search after a failed grasp.

    ## Arguments
    - `cube_material="cube"`: what the cube sounds like: wood, or `"glass"`, `"tin"`, `"cardboard"`, `"rubber"`.
    - and those of `gym_playbyear.environment.TaskEnv`.
    """
    wall = box("wall", (0.02, 0.40, 0.30), (0.20, 0.0, 0.775), WALL_COLOUR, material="wall", visuals=wall_on_the_table)
    place = (_INDICATOR_X, 0, _INDICATOR_Z)
    panel = box("indicator", _INDICATOR_HALF_SIZE, place, "0.1 0.2 0.9 1", visuals=panel_on_posts)
    return Task(
        name="OccludedGrasp-v1",
        description="Find the cube behind the wall by touch and sound, grasp it and lift it.",
        props=(wall, panel, _rails(-0.38, 0.38), _cube(2000, cube_material)),
        initialize_episode=_initialize_grasp,
        reset_options=("cube_position", "cube_yaw"),
        expert=GraspExpert,
        blind={name: partial(BlindGrasp, strategy=name) for name in BLIND_GRASPS},
        horizon=250,
        **_of_both(_is_lifted),
    )


def occluded_pick_place(*, cube_material: str = "cube") -> Task:
    """
    ## Description
    A red cube lies behind a half wall that hides it from the camera; beside the wall, in plain view, stands a tray. The arm
    has to sweep along the wall until it hears itself touch the cube, hop over it, grasp it, carry it to the tray and let go.
    After Du et al., "Play it by Ear" (RSS 2022).

    ## Action Space
    `Box(-1, 1, (4,), float32)`: displacement of the end effector along x, y, z in units of 0.05 m per step, and the gripper
    (> 0 closes). The hand's orientation is fixed. 20 steps per second. After a change of the gripper command the next one is
    ignored for 2 s, as on the authors' robot. What lies beyond [-1, 1] is clipped.

    ## Observation Space
    A dictionary:
    - `pixels.front`: `(image_size, image_size, 3)` uint8, the camera in front of the wall;
    - `agent_pos`: `(7,)` float32, end effector x, y, z [m, from the robot's base], two finger positions [m], two finger
      velocities [m/s], with the noise and resolution of a real arm's encoders;
    - `audio.<microphone>`: `(sample_rate / 20,)` int16, what the microphone heard during the last step (`sound="waveform"`);
    - `contact_force`: `(6,)` float32, mean net contact force [N] and torque [Nm] on the cube (`sound="contact_force"`).

    ## Rewards
    1 at the step that solves the task, otherwise 0.

    ## Success Criteria
    The cube's centre is within 0.025 m of the tray's in x and in y, and lower than z = 0.85 m, while no finger touches it, for
    half a second, and moves less than 1.5 cm meanwhile.
    `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the table, within 2 cm of the same point. The cube's place behind the wall, its yaw
    and the tray's place are random. `reset(options={"cube_position": (x, y), "cube_yaw": yaw, "bin_position": (x, y)})` sets
    them.

    ## Episode Termination
    Terminated, and `info["end"]` says why: "success"; "shoved", when the cube was moved more than 2.2 cm before both fingers
    held it; "pressed", when the hand pressed on the cube with more than 5 N, which stops an arm for people (a squeeze between
    the fingers may be harder); "groped", when the fingers closed on nothing for the third time. Truncated, as "time", after
    `horizon` steps (400): enough for a second search after a failed grasp.

    ## Arguments
    - `cube_material="cube"`: what the cube sounds like: wood, or `"glass"`, `"tin"`, `"cardboard"`, `"rubber"`.
    - and those of `gym_playbyear.environment.TaskEnv`.
    """
    wall = box("wall", (0.02, 0.20, 0.18), (0.10, 0.20, 0.80), WALL_COLOUR, material="wall", visuals=wall_on_the_table)
    bin_ = tray("bin", _BIN_HALF_WIDTH, _BIN_WALL_HALF_HEIGHT)
    return Task(
        name="OccludedPickPlace-v1",
        description="Find the cube behind the wall by touch and sound, grasp it and put it into the tray.",
        props=(wall, bin_, _rails(0.0, 0.38), _cube(3000, cube_material)),
        initialize_episode=_initialize_pick_place,
        reset_options=("cube_position", "cube_yaw", "bin_position"),
        expert=PickPlaceExpert,
        blind={name: partial(BlindPickPlace, strategy=name) for name in BLIND_GRASPS},
        horizon=400,
        **_of_both(_is_in_the_tray),
    )


def _of_both(condition: Callable[[Any], bool]) -> dict[str, Any]:
    """What both tasks have in common, as arguments of `Task`: they are solved when `condition(env)` has lasted long enough."""
    return {
        "arm": Panda(),
        "arena": TABLE,
        "cameras": (FRONT_CAMERA,),
        "success": Success(condition, CUBE, _HOLD_SECONDS, _STILL),
        "terminations": (
            Shoved(CUBE, MAX_SHOVE, _CARRIED_HEIGHT, _SQUEEZE),
            Pressed(CUBE, _MAX_PRESS, FINGER_FRICTION),
            Groped(_CLOSINGS),
        ),
        "early_action": ClosedUnheard(CUBE),
        "gate": InterventionGate,
        "force_proxy_of": CUBE,
    }


def _cube(density: float, material: str) -> Prop:
    """The red cube, hidden; `material` is what it sounds like."""
    check_option("cube_material", material, CUBE_MATERIALS)
    half_size, red = (CUBE_HALF_SIZE,) * 3, "0.85 0.1 0.1 1"
    return loose_box(
        CUBE, half_size, density=density, friction=_CUBE_FRICTION, rgba=red, material=material, hidden=True
    )


def _rails(lower: float, upper: float) -> Prop:
    """Two low rails beside the line of the cube, from y to y [m]: a hand comes to it from above or along them, never across."""
    half_size = f"{_RAIL_THICKNESS / 2} {(upper - lower) / 2} {_RAIL_HEIGHT / 2}"
    geoms = "".join(
        f'<geom type="box" size="{half_size}" pos="{side * (_RAIL_GAP + _RAIL_THICKNESS) / 2} 0 0" rgba="0.62 0.5 0.36 1"/>'
        for side in (-1, 1)
    )
    middle = f"0 {(lower + upper) / 2} {TABLE_TOP + _RAIL_HEIGHT / 2}"
    return Prop("rails", f'<body name="rails" pos="{middle}">{geoms}</body>', material="table")


def _place_cube(env: Any, options: dict[str, Any], x_range: tuple[float, float], y_range: tuple[float, float]) -> float:
    """Puts the cube where it is drawn to be, or where `options` want it. Returns its y [m]."""
    x, y = (env.np_random.uniform(*limits) for limits in (x_range, y_range))
    yaw = env.np_random.uniform(-_CUBE_YAW, _CUBE_YAW)
    x, y = on_table("cube_position", options.get("cube_position", (x, y)))
    env.set_pose(CUBE, (x, y, TABLE_TOP + CUBE_HALF_SIZE), options.get("cube_yaw", yaw))
    return y


def _initialize_grasp(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    y = _place_cube(env, options, (0.0, 0.0), _GRASP_RANGE)
    lower, upper = _GRASP_RANGE
    part = int(np.clip(_PANELS * (y - lower) / (upper - lower), 0, _PANELS - 1))
    width = (upper - lower) / _PANELS
    shown = (lower + part * width, lower + (part + 1) * width)
    env.set_pose("indicator", (_INDICATOR_X, np.mean(shown), _INDICATOR_Z))
    return {"hidden_range": shown}


def _initialize_pick_place(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    _place_cube(env, options, (-0.001, 0.001), _PICK_PLACE_RANGE)
    place = (0.0, BIN_Y - env.np_random.uniform(0, BIN_Y_RANGE))
    bin_position = np.array([*on_table("bin_position", options.get("bin_position", place)), TABLE_TOP])
    env.set_pose("bin", bin_position)
    return {"hidden_range": _PICK_PLACE_RANGE, "bin_position": bin_position}


def _is_lifted(env: Any) -> bool:
    return bool(env.position(CUBE)[2] > TABLE_TOP + _LIFT_HEIGHT)


def _is_in_the_tray(env: Any) -> bool:
    place = env.position(CUBE)
    offset = np.abs(place - env.shown["bin_position"])
    inside = (offset[:2] < PLACE_TOLERANCE).all() and place[2] < _PLACE_HEIGHT
    return bool(inside and env.contact_forces["gripper-cube"] == 0)
