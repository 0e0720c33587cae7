"""Three things that the policy `playbyear` does not bring, added by name.

    pip install ./examples/extension
    playbyear-train --preset=cpu --policy.audio_encoder=spectrogram_gru --policy.audio_steps=[remove_offset] ...
    playbyear-dagger --expert.type=startled ...

Importing this registers them; every command of LeRobot's and of ours does so. A policy that was trained with them needs this
package wherever it acts.
"""

from lerobot_policy_playbyear_extras.encoder import SpectrogramGRU, WaveformCNN
from lerobot_policy_playbyear_extras.expert import StartledConfig
from lerobot_policy_playbyear_extras.microphone import RemoveOffset

__all__ = ["RemoveOffset", "SpectrogramGRU", "StartledConfig", "WaveformCNN"]
