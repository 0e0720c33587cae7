"""The module that LeRobot's plugin discovery imports: it registers the policy `playbyear`, and changes nothing else.

Every command of LeRobot imports it, so that it brings no more than the registration takes: LeRobot finds the network and the
processors by their modules' names. Import `lerobot_playbyear` in programs of your own.
"""

from typing import TYPE_CHECKING

from lerobot_playbyear import __version__, lazy_names
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.environment_sound import Pcm16ToFloatProcessorStep

if TYPE_CHECKING:
    from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
    from lerobot_playbyear.policy.processor_playbyear import make_playbyear_pre_post_processors

__all__ = [
    "Pcm16ToFloatProcessorStep",
    "PlaybyearConfig",
    "PlaybyearPolicy",
    "__version__",
    "make_playbyear_pre_post_processors",
]

_NETWORK = {"modeling_playbyear": ("PlaybyearPolicy",), "processor_playbyear": ("make_playbyear_pre_post_processors",)}
__getattr__ = lazy_names("lerobot_playbyear.policy", _NETWORK)
