"""The methods of interactive imitation, `--method.type`."""

from lerobot_playbyear.dagger.methods import human_gated, redo, robot_gated, weighted
from lerobot_playbyear.dagger.methods.base import Learned, Method, MethodConfig, Tools
from lerobot_playbyear.dagger.methods.human_gated import HgDaggerConfig

__all__ = [
    "HgDaggerConfig",
    "Learned",
    "Method",
    "MethodConfig",
    "Tools",
    "human_gated",
    "redo",
    "robot_gated",
    "weighted",
]
