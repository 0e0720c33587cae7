"""The sound of an environment of one's own, on its way from `preprocess_observation` to a policy."""

from dataclasses import dataclass

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_playbyear.datasets.features import AUDIO_PREFIX

_FULL_SCALE = 32768  # int16: samples are in [-32768, 32767]


@dataclass
@ProcessorStepRegistry.register(name="playbyear_pcm16_to_float")
class Pcm16ToFloatProcessorStep(ObservationProcessorStep):
    """Divides the int16 sound of an environment by 32,768: policies want floats in [-1, 1].

    An environment gives `audio.<microphone>` as int16; LeRobot's `preprocess_observation` makes floats of it without scaling
    them, and nothing in them tells a quiet room from the loudest noise. So the environment's configuration says what they are:

        def get_env_processors(self):
            return PolicyProcessorPipeline(steps=[Pcm16ToFloatProcessorStep()]), PolicyProcessorPipeline(steps=[])

    Every command that lets a policy act asks for it: lerobot-eval, lerobot-train, and ours. Datasets keep int16.
    """

    def observation(self, observation: dict) -> dict:
        """Scales every `observation.audio.<microphone>`, (B, S).

        Raises:
            ValueError: The samples are not those of int16 sound.
        """
        sound = {key: _scaled(value, key) for key, value in observation.items() if key.startswith(AUDIO_PREFIX)}
        return {**observation, **sound}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def _scaled(samples: Tensor, key: str) -> Tensor:
    wave = samples.to(torch.float32)
    strange = (wave != wave.round()) | (wave.abs() > _FULL_SCALE)
    if strange.any():
        raise ValueError(
            f"{key} holds {wave[strange][0].item():.6g}, which is no int16 sample. Floats in [-1, 1] are what a policy wants: "
            f"let {Pcm16ToFloatProcessorStep.__name__} out of the environment's `get_env_processors`. Other integers: give "
            "int16 in the environment."
        )
    return wave / _FULL_SCALE
