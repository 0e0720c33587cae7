"""`--policy.audio_steps=[remove_offset]`"""

from dataclasses import dataclass

from lerobot.processor import ProcessorStepRegistry
from torch import Tensor

from lerobot_playbyear.policy.extension import MicrophoneStep


@dataclass
@ProcessorStepRegistry.register(name="remove_offset")
class RemoveOffset(MicrophoneStep):
    """For microphones whose silence is not zero: of every frame so much of its mean is taken away.

    Args:
        share: `--policy.extension_options='{"remove_offset": {"share": 0.5}}'` takes half of it.
    """

    share: float = 1.0

    def sound(self, wave: Tensor) -> Tensor:
        """(..., S) -> (..., S)."""
        return wave - self.share * wave.mean(dim=-1, keepdim=True)
