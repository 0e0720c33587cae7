"""A robot that is not there, for tests: a LeRobot plugin with an arm, a leader, and a sound that goes through a sound server.

Its folder on PYTHONPATH is all that LeRobot's discovery needs.
"""

from lerobot_robot_playbyear_sim.devices import (
    PlaybyearSim,
    PlaybyearSimConfig,
    PlaybyearSimLeader,
    PlaybyearSimLeaderConfig,
)
from lerobot_robot_playbyear_sim.joints import JointArm, JointArmConfig, JointLeader, JointLeaderConfig

__all__ = [
    "JointArm",
    "JointArmConfig",
    "JointLeader",
    "JointLeaderConfig",
    "PlaybyearSim",
    "PlaybyearSimConfig",
    "PlaybyearSimLeader",
    "PlaybyearSimLeaderConfig",
]
