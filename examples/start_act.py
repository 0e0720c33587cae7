"""An ACT that has learned nothing, to begin from: it sees pictures cut to what matters, and needs no weights of ImageNet.

    python examples/start_act.py outputs/demos outputs/start --crop gripper=0,96,106,384 --size=48 dim_model=128
    lerobot-train --policy.path=outputs/start --dataset.use_imagenet_stats=false --dataset.root=outputs/demos ...

A microphone's picture carries a timecode and samples beside its spectrogram; LeRobot's own `image_crop_resize_processor`, which
stands in the checkpoint from then on, cuts them away. ACT's ResNet has batch norms that never learn: their statistics come with
the weights of ImageNet. With random weights and statistics of 0 and 1 the encodings of different frames are much alike. Here
the statistics are those of the dataset's own pictures, as a batch norm that learns has them at first.
"""

import argparse
from pathlib import Path

import draccus
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.processor import ImageCropResizeProcessorStep
from lerobot.utils.constants import OBS_IMAGES, OBS_STR
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import FrozenBatchNorm2d

N_FRAMES = 200


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


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("dataset", type=Path, help="folder of the dataset")
    parser.add_argument("folder", type=Path, help="of the checkpoint that is made")
    parser.add_argument("options", nargs="*", help="of ACT, NAME=VALUE")
    parser.add_argument("--crop", action="append", default=[], help="CAMERA=TOP,LEFT,HEIGHT,WIDTH [pixels]")
    parser.add_argument("--size", type=int, help="to which all pictures are resized, square [pixels]")
    parser.add_argument("--seed", type=int, default=0, help="of the weights, and of the frames that are looked at")
    given = parser.parse_intermixed_args()
    cuts = {
        f"{OBS_IMAGES}.{name}": [int(edge) for edge in cut.split(",")]
        for name, cut in (c.split("=") for c in given.crop)
    }
    options = [f"--{option}" for option in ("device=cpu", "pretrained_backbone_weights=null", *given.options)]
    config = draccus.parse(ACTConfig, args=options)
    data = LeRobotDataset(f"local/{given.dataset.name}", root=given.dataset, video_backend="pyav")
    torch.manual_seed(given.seed)
    policy = make_policy(config, ds_meta=data.meta)
    before, after = make_pre_post_processors(config, dataset_stats=data.meta.stats)
    before.steps = [
        ImageCropResizeProcessorStep(cuts or None, (given.size, given.size) if given.size else None),
        *before.steps,
    ]
    frames = [data[index] for index in torch.randperm(len(data))[:N_FRAMES].tolist()]
    keys = [key for key in frames[0] if key.startswith(f"{OBS_STR}.")]
    batch = before({key: torch.stack([frame[key] for frame in frames]) for key in keys})
    pictures = [batch[key] for key in keys if key.startswith(OBS_IMAGES)]
    size = min(tuple(each.shape[-2:]) for each in pictures)
    calibrate(policy.model.backbone, torch.cat([functional.interpolate(each, size, mode="area") for each in pictures]))
    policy.config.device = ACTConfig().device  # where lerobot-train will learn
    for part in (policy, before, after):
        part.save_pretrained(given.folder)


if __name__ == "__main__":
    main()
