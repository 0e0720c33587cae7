"""The module that LeRobot's plugin discovery imports: it registers the policy `playbyear` and the camera type `microphone`,
and changes nothing else.

Every command of LeRobot imports it, so that it brings no more than the registration takes: LeRobot finds the network by
its module's name. Import `lerobot_playbyear` in programs of your own.
"""

from typing import TYPE_CHECKING

from lerobot_playbyear import __version__, lazy_names
from lerobot_playbyear.microphones.camera import MicrophoneCamera, MicrophoneCameraConfig
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.processor_playbyear import (
    MicrophonePicturesToAudioStep,
    Pcm16ToFloatProcessorStep,
    make_playbyear_pre_post_processors,
)

if TYPE_CHECKING:
    from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

__all__ = [
    "MicrophoneCamera",
    "MicrophoneCameraConfig",
    "MicrophonePicturesToAudioStep",
    "Pcm16ToFloatProcessorStep",
    "PlaybyearConfig",
    "PlaybyearPolicy",
    "__version__",
    "make_playbyear_pre_post_processors",
]

__getattr__ = lazy_names("lerobot_playbyear.policy", {"modeling_playbyear": ("PlaybyearPolicy",)})
