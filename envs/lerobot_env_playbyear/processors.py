"""What happens to an environment's observation between `preprocess_observation` and the policy."""

from dataclasses import dataclass

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_PREFIX

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


@dataclass
@ProcessorStepRegistry.register(name="playbyear_sound_as_state")
class SoundAsStateProcessorStep(ObservationProcessorStep):
    """Gives the sound of a frame as a state, for policies that read states: `--env.sound_as_state=true`.

    `observation.environment_state`, (B, S of all microphones), holds the samples of every `observation.audio.<mic>`, (B, S), in
    the order of their keys; all else stays. The numbers are those that `lerobot_playbyear.datasets.sound_as_state` writes
    into a dataset, bit for bit, when `PcmToFloatProcessorStep` comes before.
    """

    def observation(self, observation: dict) -> dict:
        """Joins the microphones.

        Raises:
            ValueError: There is none.
        """
        keys = sorted(key for key in observation if key.startswith(OBS_AUDIO_PREFIX))
        if not keys:
            raise ValueError(
                f"'{OBS_ENV_STATE}' is to hold the sound, and the observation has {', '.join(observation)}; wanted a key "
                f"'{OBS_AUDIO_PREFIX}<microphone>'. Give the environment a microphone, or leave out --env.sound_as_state."
            )
        return {**observation, OBS_ENV_STATE: torch.cat([observation[key] for key in keys], dim=-1)}  # (B, sum of S)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        observed = features[PipelineFeatureType.OBSERVATION]
        size = sum(feature.shape[0] for key, feature in observed.items() if key.startswith(OBS_AUDIO_PREFIX))
        state = {OBS_ENV_STATE: PolicyFeature(type=FeatureType.ENV, shape=(size,))}
        return {**features, PipelineFeatureType.OBSERVATION: {**observed, **state}}
