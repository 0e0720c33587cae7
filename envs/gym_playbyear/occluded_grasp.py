"""Occluded Grasp with Visual Indicator (paper, section "Simulated Domain and Tasks")."""

from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP, WALL_COLOUR, box
from gym_playbyear.blind import BLIND_STRATEGIES, SteadyBlindGrasp
from gym_playbyear.cube import cube, cube_task, place_cube, rails
from gym_playbyear.experts import EXACT_EXPERT, SteadyGraspExpert
from gym_playbyear.looks_props import panel_on_posts, wall_on_the_table
from gym_playbyear.task import Prop, Task
from gym_playbyear.variant import Variant

WALL_HALF_SIZE = (0.02, 0.40, 0.30)  # m
WALL_CENTRE = (0.20, 0.0, 0.775)  # m: its top is 0.275 m above the table
INDICATOR_HALF_SIZE = (0.02, 0.1, 0.1)  # m
INDICATOR_X, INDICATOR_Z = 0.25, 0.95  # m
LIFT_HEIGHT = 0.04  # m above the table

NUMBERS = Variant(
    cube_x=(0.0, 0.0),
    cube_y=(-0.28, 0.28),
    cube_density=2000,
    horizon=250,
    max_press=5.0,
    closings=3,
    hold_s=0.5,
    max_shove=0.022,
    squeeze=20.0,
    panels=2,
    sweep_step=(0.005, 0.008),
)


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
    ignored for 2 s, as on the authors' robot.

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
    Terminated, and `info["end"]` says why: "success"; "shoved", when the cube was shoved more than 2.2 cm along the table;
    "pressed", when the hand came down on the cube with more than 5 N, which stops an arm for people (a squeeze between the
    fingers may be harder); "groped", when the fingers closed on nothing for the third time. Truncated, as "time", after
    `horizon` steps (250): enough for a second search after a failed grasp.

    ## Arguments
    - `image_size=84`: pixels of the square picture.
    - `sample_rate=16000`: samples per second; a multiple of 20.
    - `sound="waveform"`: or `"contact_force"` (the paper's stand-in for sound), or `"none"`.
    - `noise_level=1.0`: scales background noise and motor hum.
    - `cube_material="cube"`: what the cube sounds like: wood, or `"glass"`, `"tin"`, `"cardboard"`, `"rubber"`.
    - `microphones=("gripper",)`: or two ears, `"left_finger"` and `"right_finger"`, `"table"`, `"room"`.
    - `horizon=None`: steps of an episode; None is the task's.
    - `hidden_object=True`: False is the twin world, in which the hand passes through the cube, and nothing else differs.
    - `render_mode=None`: or `"rgb_array"`, `"human"`; `render_size=480`: pixels of the picture that `render()` returns.

    ## Version History
    - v1: ends attempts that press or grope, wants the cube to stay where it belongs, leaves time for a second search.
    """
    return _task(
        "OccludedGrasp-v1",
        NUMBERS,
        cube_material,
        (rails(-0.38, 0.38),),
        expert=partial(SteadyGraspExpert, config=EXACT_EXPERT),
        blind={name: partial(SteadyBlindGrasp, strategy=name) for name in BLIND_STRATEGIES},
    )


def _task(name: str, numbers: Variant, cube_material: str, more: tuple[Prop, ...] = (), **scripts: Any) -> Task:
    wall = box("wall", WALL_HALF_SIZE, WALL_CENTRE, WALL_COLOUR, material="wall", looks=wall_on_the_table)
    place = (INDICATOR_X, 0, INDICATOR_Z)
    panel = box("indicator", INDICATOR_HALF_SIZE, place, "0.1 0.2 0.9 1", looks=panel_on_posts)
    return Task(
        name=name,
        description="Find the cube behind the wall by touch and sound, grasp it and lift it.",
        props=(wall, panel, *more, cube(numbers, cube_material)),
        place=_place,
        **cube_task(numbers, _is_lifted),
        **scripts,
    )


def _place(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    y = place_cube(env, options)
    lower, upper = env.variant.cube_y
    n_parts = env.variant.panels
    part = int(np.clip(n_parts * (y - lower) / (upper - lower), 0, n_parts - 1))
    width = (upper - lower) / n_parts
    shown = (lower + part * width, lower + (part + 1) * width)
    env.put("indicator", (INDICATOR_X, np.mean(shown), INDICATOR_Z))
    return {"hidden_range": shown}


def _is_lifted(env: Any) -> bool:
    return bool(env.cube_position[2] > TABLE_TOP + LIFT_HEIGHT)
