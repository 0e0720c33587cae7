"""`--policy.audio_steps=[remove_offset]`"""

from dataclasses import dataclass

from lerobot.processor import ProcessorStepRegistry
from torch import Tensor

from lerobot_playbyear.policy.extension import MicrophoneStep


@dataclass
@ProcessorStepRegistry.register(name="remove_offset")
class RemoveOffset(MicrophoneStep):
    """For microphones whose silence is not zero: every frame's mean becomes zero."""

    def sound(self, wave: Tensor) -> Tensor:
        """(..., S) -> (..., S)."""
        return wave - wave.mean(dim=-1, keepdim=True)
