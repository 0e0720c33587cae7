"""Occluded Pick and Place (paper, section "Simulated Domain and Tasks")."""

from typing import Any, ClassVar

import numpy as np

from gym_playbyear.arena import TABLE_TOP, box_xml, tray_xml
from gym_playbyear.base import PlayByEarEnv
from gym_playbyear.blind import BlindPickPlace
from gym_playbyear.experts import PickPlaceExpert
from gym_playbyear.variant import PAPER, Variant

WALL_HALF_SIZE = (0.02, 0.20, 0.18)  # m
WALL_CENTRE = (0.10, 0.20, 0.80)  # m
BIN_HALF_WIDTH = 0.04  # m
BIN_WALL_HALF_HEIGHT = 0.02  # m
BIN_Y, BIN_Y_RANGE = -0.15, 0.1  # m: the bin stands at y = -0.15 - U(0, 0.1)
PLACE_TOLERANCE = 0.025  # m
PLACE_HEIGHT = 0.85  # m, world frame


class OccludedPickPlaceEnv(PlayByEarEnv):
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
    The cube's centre is within 0.025 m of the tray's in x and in y, and lower than z = 0.85 m, while the fingers do not hold
    it. `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the table, within 2 cm of the same point. The cube's place behind the wall, its yaw and the
    tray's place are random. `reset(options={"cube_position": (x, y), "cube_yaw": yaw, "bin_position": (x, y)})` sets them.

    ## Episode Termination
    Terminated at success, and as failed when the cube was shoved more than 3 cm along the table (not in the paper's variant);
    truncated after `horizon` steps.

    ## Arguments
    - `image_size=84`: pixels of the square picture.
    - `sample_rate=16000`: samples per second; a multiple of 20.
    - `sound="waveform"`: or `"contact_force"` (the paper's stand-in for sound), or `"none"`.
    - `noise_level=1.0`: scales background noise and motor hum.
    - `cube_material="cube"`: what the cube sounds like: wood, or `"glass"`, `"tin"`, `"cardboard"`, `"rubber"`.
    - `microphones=("gripper",)`: `"table"` is the other one.
    - `horizon=None`: steps of an episode; None is the variant's.
    - `variant="default"`: or `"paper"`, the numbers of the paper and its code, in which a blind gripper mostly succeeds.
    - `render_mode=None`: or `"rgb_array"`, `"human"`; `render_size=480`: pixels of the picture that `render()` returns.

    ## Version History
    - v0: first version.
    """

    task = "OccludedPickPlace-v0"
    task_description = "Find the cube behind the wall by touch and sound, grasp it and put it into the tray."
    _expert, _blind = PickPlaceExpert, BlindPickPlace
    _scene_bodies = ("table", "wall", "bin")
    VARIANTS: ClassVar[dict[str, Variant]] = {
        "default": Variant(cube_x=(-0.001, 0.001), cube_y=(0.11, 0.31), cube_density=3000, horizon=220),
        "paper": Variant(cube_x=(-0.001, 0.001), cube_y=(0.15, 0.179), cube_density=3000, horizon=400, **PAPER),
    }

    def _scene_xml(self) -> str:
        return box_xml("wall", WALL_HALF_SIZE, WALL_CENTRE, "0.55 0.57 0.62 1") + tray_xml(
            "bin", BIN_HALF_WIDTH, BIN_WALL_HALF_HEIGHT
        )

    def _place(self, options: dict[str, Any]) -> None:
        self._place_cube(options)
        bin_position = (0.0, BIN_Y - self.np_random.uniform(0, BIN_Y_RANGE))
        self.bin_position = np.array([*options.get("bin_position", bin_position), TABLE_TOP])
        self.model.body("bin").pos[:] = self.bin_position

    def _is_success(self) -> bool:
        offset = np.abs(self.cube_position - self.bin_position)
        inside = (offset[:2] < PLACE_TOLERANCE).all() and self.cube_position[2] < PLACE_HEIGHT
        return bool(inside and self.contact_forces["gripper-cube"] == 0)

    @property
    def hidden_range(self) -> tuple[float, float]:
        """Where along y the cube may be, as far as the camera tells [m]."""
        return self.variant.cube_y
