"""Pre- and post-processing of the policy `playbyear`: LeRobot's own steps, with sound left as it is."""

from typing import Any

import torch
from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


def make_playbyear_pre_post_processors(
    config: PlaybyearConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Builds both pipelines.

    Only the low-dimensional observations and the action are normalised. Images and waveforms reach the network as they
    are, which carries its own front ends.

    Args:
        config: The policy's configuration, with its features.
        dataset_stats: LeRobot's statistics of the dataset.
    """
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    steps.normalize.normalize_observation_keys = set(config.low_dimensional_keys)
    return make_policy_processor_pipelines(
        input_steps=[steps.rename_observations, steps.add_batch_dim, steps.to_device, steps.normalize],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
