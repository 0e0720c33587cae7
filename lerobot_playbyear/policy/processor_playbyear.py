"""Pre- and post-processing of the policy `playbyear`: LeRobot's own steps, with sound left as it is."""

from typing import Any

import torch
from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.microphone_step import MicrophonePicturesToAudioStep


def make_playbyear_pre_post_processors(
    config: PlaybyearConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Builds both pipelines.

    Only the low-dimensional observations and the action are normalised. Images and waveforms reach the network as they
    are, which carries its own front ends; sound after the configured `audio_steps`. Where an observation has a microphone's
    picture instead of its sound, as on a robot, the sound is taken from the picture.

    Args:
        config: The policy's configuration, with its features.
        dataset_stats: LeRobot's statistics of the dataset.

    Raises:
        ValueError: No installed package registers one of the `audio_steps`.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    steps.normalize.normalize_observation_keys = set(config.low_dimensional_keys)
    heard = [_microphone_step(name) for name in config.audio_steps]
    if config.use_audio and config.sample_rate is not None:
        heard.insert(0, MicrophonePicturesToAudioStep(config.audio_keys, config.sample_rate, config.fps))
    return make_policy_processor_pipelines(
        input_steps=[steps.rename_observations, steps.add_batch_dim, steps.to_device, *heard, steps.normalize],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )


def _microphone_step(name: str) -> ProcessorStep:
    if name not in ProcessorStepRegistry.list():
        raise ValueError(
            f"--policy.audio_steps names '{name}', which no installed package registers in LeRobot's ProcessorStepRegistry: "
            "install the one that does; its distribution's name begins with lerobot_policy_ (docs/training.md)."
        )
    return ProcessorStepRegistry.get(name)()
