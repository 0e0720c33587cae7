"""Occluded Grasp with Visual Indicator (paper, section "Simulated Domain and Tasks")."""

from typing import Any, ClassVar

import numpy as np

from gym_playbyear.arena import TABLE_TOP, box_xml
from gym_playbyear.base import PlayByEarEnv
from gym_playbyear.blind import BlindGrasp
from gym_playbyear.experts import GraspExpert
from gym_playbyear.variant import PAPER, Variant

WALL_HALF_SIZE = (0.02, 0.40, 0.30)  # m
WALL_CENTRE = (0.20, 0.0, 0.775)  # m: its top is 0.275 m above the table
INDICATOR_HALF_SIZE = (0.02, 0.1, 0.1)  # m
INDICATOR_X, INDICATOR_Z = 0.25, 0.95  # m
LIFT_HEIGHT = 0.04  # m above the table


class OccludedGraspEnv(PlayByEarEnv):
    """
    ## Description
    A red cube lies somewhere behind a wall that hides it from the camera. A blue panel in front of the wall shows which
    quarter of the table's width holds the cube, not where in the quarter. The arm has to go behind that quarter, sweep until
    it hears itself touch the cube, hop over it, grasp it and lift it. After Du et al., "Play it by Ear" (RSS 2022).

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
    The cube's centre is more than 0.04 m above the table. `info["is_success"]` says so at every step.

    ## Starting State
    The gripper is open above the table, within 2 cm of the same point. The cube's place along the wall and its yaw are
    random. `reset(options={"cube_position": (x, y), "cube_yaw": yaw})` sets them.

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
    - `variant="default"`: or `"paper"`, the numbers of the paper and its code, in which a blind gripper often succeeds.
    - `render_mode=None`: or `"rgb_array"`, `"human"`; `render_size=480`: pixels of the picture that `render()` returns.

    ## Version History
    - v0: first version.
    """

    task = "OccludedGrasp-v0"
    task_description = "Find the cube behind the wall by touch and sound, grasp it and lift it."
    _expert, _blind = GraspExpert, BlindGrasp
    _scene_bodies = ("table", "wall")
    VARIANTS: ClassVar[dict[str, Variant]] = {
        "default": Variant(cube_x=(0.0, 0.0), cube_y=(-0.28, 0.28), cube_density=2000, horizon=102),
        "paper": Variant(cube_x=(0.0, 0.0), cube_y=(-0.17, 0.17), cube_density=2000, horizon=250, **PAPER),
    }

    def _scene_xml(self) -> str:
        wall = box_xml("wall", WALL_HALF_SIZE, WALL_CENTRE, "0.55 0.57 0.62 1")
        indicator = box_xml(
            "indicator", INDICATOR_HALF_SIZE, (INDICATOR_X, 0, INDICATOR_Z), "0.1 0.2 0.9 1", solid=False
        )
        return wall + indicator

    def _place(self, options: dict[str, Any]) -> None:
        y = self._place_cube(options)
        lower, upper = self.variant.cube_y
        self.quarter = int(np.clip(4 * (y - lower) / (upper - lower), 0, 3))
        self.model.body("indicator").pos[:] = (INDICATOR_X, np.mean(self.hidden_range), INDICATOR_Z)

    def _is_success(self) -> bool:
        return bool(self.cube_position[2] > TABLE_TOP + LIFT_HEIGHT)

    @property
    def hidden_range(self) -> tuple[float, float]:
        """Where along y the cube may be, as far as the camera tells: the indicated quarter [m]."""
        lower, upper = self.variant.cube_y
        width = (upper - lower) / 4
        return lower + self.quarter * width, lower + (self.quarter + 1) * width
