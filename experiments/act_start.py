"""A beginning for ACT where no weights of ImageNet are at hand.

LeRobot's ACT sees with a ResNet whose batch norms are frozen: their statistics come with pretrained weights, which are
downloaded. With random weights, statistics of 0 and 1 and pictures normalised as ImageNet's, the encodings of Occluded
Grasp's frames differ from each other by a fifth of their size (root mean square; camera 0.21, picture of the sound 0.17).
Here the statistics are those of the dataset's own pictures under the random weights, as a batch norm that learns has them
at first, and pictures are normalised by the dataset: 0.64 and 0.76.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.utils.constants import OBS_IMAGES, OBS_STR
from torch import Tensor, nn
from torchvision.ops import FrozenBatchNorm2d

_N_FRAMES = 200


def saved_start(options: Sequence[str], dataset: Path, folder: Path, seed: int) -> list[str]:
    """An ACT that has learned nothing, with its processors; made and saved unless it is there.

    Args:
        options: Of the policy, without `--policy.`.
        dataset: Folder of the dataset whose pictures it shall tell apart.
        folder: Of the checkpoint.
        seed: Of the weights and of the pictures that are looked at.

    Returns:
        The option that begins a training with it, without `--policy.`.
    """
    if not folder.exists():
        config = draccus.parse(ACTConfig, args=["--device=cpu", *(f"--{option}" for option in options)])
        data = LeRobotDataset(f"experiments/{dataset.name}", root=dataset, video_backend="pyav")
        torch.manual_seed(seed)
        policy = make_policy(config, ds_meta=data.meta)
        processors = make_pre_post_processors(config, dataset_stats=data.meta.stats)
        calibrate(policy.model.backbone, _pictures(data, processors[0]))
        unfinished = folder.with_name(f"{folder.name}.unfinished")
        for part in (policy, *processors):
            part.save_pretrained(unfinished)
        unfinished.rename(folder)
    return [f"path={folder}"]


def _pictures(data: LeRobotDataset, preprocessor: Any) -> Tensor:
    """(n, 3, H, W), of all cameras, as the policy sees them."""
    frames = [data[index] for index in torch.randperm(len(data))[:_N_FRAMES].tolist()]
    kept = [key for key in frames[0] if key.startswith(f"{OBS_STR}.")]
    batch = preprocessor({key: torch.stack([frame[key] for frame in frames]) for key in kept})
    return torch.cat([batch[key] for key in kept if key.startswith(OBS_IMAGES)])


@torch.no_grad()
def calibrate(network: nn.Module, images: Tensor) -> None:
    """Gives every frozen batch norm the mean and variance of what reaches it, one after the other.

    Args:
        network: With `FrozenBatchNorm2d`.
        images: (B, 3, H, W), normalised.
    """

    def take_statistics(norm: nn.Module, inputs: tuple[Tensor]) -> None:
        norm.running_mean.copy_(inputs[0].mean(dim=(0, 2, 3)))
        norm.running_var.copy_(inputs[0].var(dim=(0, 2, 3)))

    norms = [module for module in network.modules() if isinstance(module, FrozenBatchNorm2d)]
    hooks = [norm.register_forward_pre_hook(take_statistics) for norm in norms]
    network(images)
    for hook in hooks:
        hook.remove()
