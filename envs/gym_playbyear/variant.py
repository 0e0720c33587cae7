"""The numbers of the tasks with a hidden cube, which decide whether they can be solved without hearing."""

from dataclasses import dataclass, field

import numpy as np

from gym_playbyear.arm import ArmConfig
from gym_playbyear.proprioception import SensorNoise


@dataclass(frozen=True)
class Variant:
    """A task's numbers.

    cube_y, cube_x: ranges of the hidden cube's position [m]; cube_yaw: largest yaw, either way [rad];
    cube_density [kg/m3]; cube_friction: sliding friction; max_shove: how far the cube may be shoved along the table before
    the attempt has failed [m]; squeeze: force of the hand from which on the cube counts as held, not shoved [N]; max_press:
    largest force with which the hand may come down on it [N]; closings: the how-manieth closing on nothing ends the attempt;
    hold_s: for how long the cube has to stay where it is wanted [s]; horizon: steps of an episode; panels: in how many parts of
    the range a panel may show the cube; sweep_step: range of what the expert covers per step of its sweep [m]; arm, sensors:
    their numbers.
    """

    cube_x: tuple[float, float]
    cube_y: tuple[float, float]
    cube_density: float
    horizon: int
    cube_yaw: float = np.pi / 12
    cube_friction: float = 0.4
    max_shove: float = 0.03
    squeeze: float = np.inf
    max_press: float = np.inf
    closings: float = np.inf
    hold_s: float = 0.0
    panels: int = 4
    sweep_step: tuple[float, float] = (0.005, 0.011)
    arm: ArmConfig = field(default_factory=ArmConfig)
    sensors: SensorNoise = field(default_factory=SensorNoise)
