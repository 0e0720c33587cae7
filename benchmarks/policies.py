"""Policies and noise for the benchmarks of training and acting."""

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

CAMERA, MICROPHONE, STATE = "observation.images.front", "observation.audio.gripper", "observation.state"
SAMPLES, PIXELS = 800, 84  # of a frame: 16 kHz at 20 Hz, and the simulation's pictures


def make_policy(
    n_cameras: int = 1, n_microphones: int = 1, sample_rate: int = 16000, fps: int = 20, **options
) -> PlaybyearPolicy:
    """A new policy on the simulation's observations, of the paper's sizes where the options do not say otherwise."""
    image, sound = (
        PolicyFeature(FeatureType.VISUAL, (3, PIXELS, PIXELS)),
        PolicyFeature(FeatureType.STATE, (sample_rate // fps,)),
    )
    inputs = {
        **{CAMERA + str(i or ""): image for i in range(n_cameras)},
        **{MICROPHONE + str(i or ""): sound for i in range(n_microphones)},
        STATE: PolicyFeature(FeatureType.STATE, (7,)),
    }
    action = {"action": PolicyFeature(FeatureType.ACTION, (4,))}
    config = PlaybyearConfig(
        input_features=inputs,
        output_features=action,
        sample_rate=sample_rate,
        fps=fps,
        device="cpu",
        push_to_hub=False,
        **options,
    )
    return PlaybyearPolicy(config)


def bare_resnet(n_frames: int, image_size: int) -> tuple[nn.Module, Tensor]:
    """The vision encoder's ResNet alone, and frames that are already as it reads them."""
    policy = make_policy(use_audio=False)
    encoder = policy.model.vision[CAMERA.removeprefix("observation.").replace(".", "_")]
    frames = torch.rand(n_frames, 9, image_size, image_size).contiguous(memory_format=torch.channels_last)
    return encoder.network, frames


def random_runs(config: PlaybyearConfig, n: int) -> dict[str, Tensor]:
    """A training batch of n runs of noise, as `EpisodeStore` gives it: bytes and 16-bit sound."""
    batch = {STATE: torch.randn(n, config.n_run_frames, 7)}
    for key in config.camera_keys:
        batch[key] = torch.randint(0, 256, (n, config.n_image_frames, 3, PIXELS, PIXELS), dtype=torch.uint8)
    for key in config.audio_keys:
        batch[key] = (500 * torch.randn(n, config.n_audio_frames, *config.feature_shape(key))).to(torch.int16)
    batch["action"] = torch.rand(n, config.n_supervised_steps, 4) * 2 - 1
    return batch


def random_observations(config: PlaybyearConfig, n: int, n_episodes: int = 1) -> list[dict[str, Tensor]]:
    """Observations of n control steps in several episodes at once, noise, as LeRobot hands them to `select_action`."""
    return [
        {
            **{key: torch.rand(n_episodes, 3, PIXELS, PIXELS) for key in config.camera_keys},
            **{key: 0.02 * torch.randn(n_episodes, SAMPLES) for key in config.audio_keys},
            STATE: torch.randn(n_episodes, 7),
        }
        for _ in range(n)
    ]
