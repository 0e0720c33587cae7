"""The numbers of a task that decide whether it can be solved without hearing."""

from dataclasses import dataclass, field

import numpy as np

from gym_playbyear.arm import ArmConfig
from gym_playbyear.proprioception import SensorNoise


@dataclass(frozen=True)
class Variant:
    """A task's numbers.

    cube_y, cube_x: ranges of the hidden cube's position [m]; cube_yaw: largest yaw, either way [rad];
    cube_density [kg/m3]; cube_friction: sliding friction; max_shove: how far the cube may be shoved along the table before
    the attempt has failed [m]; horizon: steps of an episode; arm, sensors: their numbers.
    """

    cube_x: tuple[float, float]
    cube_y: tuple[float, float]
    cube_yaw: float
    cube_density: float
    cube_friction: float
    horizon: int
    max_shove: float = np.inf
    arm: ArmConfig = field(default_factory=ArmConfig)
    sensors: SensorNoise = field(default_factory=SensorNoise)
