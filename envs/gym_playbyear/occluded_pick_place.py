"""Occluded Pick and Place (paper, section "Simulated Domain and Tasks")."""

from functools import partial
from typing import Any

import numpy as np

from gym_playbyear.arena import TABLE_TOP, WALL_COLOUR, box, on_table, tray
from gym_playbyear.blind import BLIND_STRATEGIES, BlindPickPlace
from gym_playbyear.cube import cube, cube_task, place_cube, rails
from gym_playbyear.experts import EXACT_EXPERT, PickPlaceExpert
from gym_playbyear.looks_props import wall_on_the_table
from gym_playbyear.task import Prop, Task
from gym_playbyear.variant import Variant

WALL_HALF_SIZE = (0.02, 0.20, 0.18)  # m
WALL_CENTRE = (0.10, 0.20, 0.80)  # m
BIN_HALF_WIDTH = 0.04  # m
BIN_WALL_HALF_HEIGHT = 0.02  # m
BIN_Y, BIN_Y_RANGE = -0.15, 0.1  # m: the bin stands at y = -0.15 - U(0, 0.1)
PLACE_TOLERANCE = 0.025  # m
PLACE_HEIGHT = 0.85  # m, world frame

NUMBERS = Variant(
    cube_x=(-0.001, 0.001),
    cube_y=(0.06, 0.34),
    cube_density=3000,
    horizon=400,
    max_press=5.0,
    closings=3,
    hold_s=0.5,
    max_shove=0.022,
    squeeze=20.0,
    sweep_step=(0.005, 0.008),
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
    The cube's centre is within 0.025 m of the tray's in x and in y, and lower than z = 0.85 m, while no finger touches it, for
    half a second, and moves less than 1.5 cm meanwhile.
    `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the table, within 2 cm of the same point. The cube's place behind the wall, its yaw
    and the tray's place are random. `reset(options={"cube_position": (x, y), "cube_yaw": yaw, "bin_position": (x, y)})` sets
    them.

    ## Episode Termination
    Terminated, and `info["end"]` says why: "success"; "shoved", when the cube was shoved more than 2.2 cm along the table;
    "pressed", when the hand came down on the cube with more than 5 N, which stops an arm for people (a squeeze between the
    fingers may be harder); "groped", when the fingers closed on nothing for the third time. Truncated, as "time", after
    `horizon` steps (400): enough for a second search after a failed grasp.

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
        "OccludedPickPlace-v1",
        NUMBERS,
        cube_material,
        (rails(0.0, 0.38),),
        expert=partial(PickPlaceExpert, config=EXACT_EXPERT),
    )


def _task(name: str, numbers: Variant, cube_material: str, more: tuple[Prop, ...] = (), **traits: Any) -> Task:
    wall = box("wall", WALL_HALF_SIZE, WALL_CENTRE, WALL_COLOUR, material="wall", looks=wall_on_the_table)
    return Task(
        name=name,
        description="Find the cube behind the wall by touch and sound, grasp it and put it into the tray.",
        props=(wall, tray("bin", BIN_HALF_WIDTH, BIN_WALL_HALF_HEIGHT), *more, cube(numbers, cube_material)),
        place=_place,
        blind={name: partial(BlindPickPlace, strategy=name) for name in BLIND_STRATEGIES},
        **cube_task(numbers, _is_in_the_tray),
        **traits,
    )


def _place(env: Any, options: dict[str, Any]) -> dict[str, Any]:
    place_cube(env, options)
    place = (0.0, BIN_Y - env.np_random.uniform(0, BIN_Y_RANGE))
    bin_position = np.array([*on_table("bin_position", options.get("bin_position", place)), TABLE_TOP])
    env.put("bin", bin_position)
    return {"hidden_range": env.variant.cube_y, "bin_position": bin_position}


def _is_in_the_tray(env: Any) -> bool:
    offset = np.abs(env.cube_position - env.bin_position)
    inside = (offset[:2] < PLACE_TOLERANCE).all() and env.cube_position[2] < PLACE_HEIGHT
    return bool(inside and env.contact_forces["gripper-cube"] == 0)
