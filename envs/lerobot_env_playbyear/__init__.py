"""Registers the tasks of `gym_playbyear` with LeRobot as `--env.type=playbyear`.

LeRobot's scripts find this package by its name and import it; nothing needs to be imported by hand.
"""

from lerobot_env_playbyear.config import PcmToFloatProcessorStep, PlaybyearEnvConfig

__version__ = "0.1.0"

__all__ = ["PcmToFloatProcessorStep", "PlaybyearEnvConfig"]
