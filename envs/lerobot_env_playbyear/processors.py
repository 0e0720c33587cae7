"""What happens to an environment's observation between `preprocess_observation` and the policy."""

from dataclasses import dataclass

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_PREFIX

OBS_AUDIO_PREFIX = OBS_PREFIX + "audio."
PCM_FULL_SCALE = 32768.0  # int16: samples are in [-32768, 32767]


@dataclass
@ProcessorStepRegistry.register(name="playbyear_pcm_to_float")
class PcmToFloatProcessorStep(ObservationProcessorStep):
    """Scales the PCM of an environment's microphones from int16's range to [-1, 1].

    The environment gives `audio.<mic>` as int16 at full scale; LeRobot's `preprocess_observation` makes floats of it
    without scaling them. This step divides every `observation.audio.<mic>`, (B, S) float32 or integer, by 32768, so
    that floats are in [-1, 1] again wherever a policy sees them. It runs once per step, in `lerobot-eval` and in
    `lerobot-train`'s evaluation, both of which ask the environment's configuration for it.

    For environments of other people the policy's distribution has the same step, `playbyear_pcm16_to_float`; neither of the
    two distributions needs the other.
    """

    def observation(self, observation: dict) -> dict:
        for key, value in observation.items():
            if key.startswith(OBS_AUDIO_PREFIX):
                observation[key] = torch.as_tensor(value).to(torch.float32) / PCM_FULL_SCALE  # (B, S)
        return observation

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features
