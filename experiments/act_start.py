"""A beginning for ACT where no weights of ImageNet are at hand.

    python -m experiments.act_start outputs/seen outputs/start dim_model=128
    lerobot-train --policy.path=outputs/start --dataset.use_imagenet_stats=false --dataset.root=outputs/seen ...
    python -m experiments.act_start outputs/demos outputs/start dim_model=128 --crop gripper=0,96,95,64 --size=48

LeRobot's ACT sees with a ResNet whose batch norms are frozen: their statistics come with pretrained weights, which are
downloaded. With random weights, statistics of 0 and 1 and pictures normalised as ImageNet's the encodings of different
frames are much alike. Here the statistics are those of the dataset's own pictures under the random weights, as a batch norm
that learns has them at first. The command prints by how much the encodings of 200 frames differ, relative to their size.

With `--crop` and `--size` LeRobot's own step for it, `image_crop_resize_processor`, stands in the checkpoint's preprocessor:
what a microphone's picture carries beside its spectrogram can be cut away.
"""

import argparse
import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import IMAGENET_STATS
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.processor import ImageCropResizeProcessorStep
from lerobot.utils.constants import OBS_IMAGES, OBS_STR
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import FrozenBatchNorm2d

from experiments.protocol import shown

_N_FRAMES = 200
_NOTE = "start.json"


def saved_start(
    options: Sequence[str], dataset: Path, folder: Path, seed: int, crop: ImageCropResizeProcessorStep | None = None
) -> str:
    """An ACT that has learned nothing, with its processors; made and saved unless it is there.

    Args:
        options: Of the policy, without `--policy.`.
        dataset: Folder of the dataset whose pictures it tells apart.
        folder: Of the checkpoint; one that was made with other arguments is made again.
        seed: Of the weights and of the pictures that are looked at.
        crop: What the preprocessor does with pictures first.

    Returns:
        The command that makes it.
    """
    note, made = folder / _NOTE, [*options, dataset.name, seed, *([crop.get_config()] if crop else [])]
    if not note.exists() or json.loads(note.read_text()) != made:
        shutil.rmtree(folder, ignore_errors=True)
        policy, processors, pictures = _prepared(options, dataset, seed, crop)
        calibrate(policy.model.backbone, alike(pictures.values()))
        for part in (policy, *processors):
            part.save_pretrained(folder)
        note.write_text(json.dumps(made))
    return shown(["python", "-m", "experiments.act_start", str(dataset), str(folder), *options, f"--seed={seed}"])


def difference(backbone: nn.Module, images: Tensor) -> float:
    """Of the encodings of pictures from their mean, relative to their size; both root mean squares.

    Args:
        backbone: Gives a dictionary with "feature_map".
        images: (B, 3, H, W), normalised.
    """
    with torch.no_grad():
        encoded = backbone(images)["feature_map"]
    return float(encoded.var(dim=0).mean().sqrt() / encoded.square().mean().sqrt())


def _prepared(
    options: Sequence[str], dataset: Path, seed: int, crop: ImageCropResizeProcessorStep | None = None
) -> tuple[Any, tuple[Any, Any], dict[str, Tensor]]:
    """A new policy, its processors, and normalised pictures of every camera, (n, 3, H, W)."""
    config = draccus.parse(ACTConfig, args=["--device=cpu", *(f"--{option}" for option in options)])
    data = LeRobotDataset(f"experiments/{dataset.name}", root=dataset, video_backend="pyav")
    torch.manual_seed(seed)
    policy = make_policy(config, ds_meta=data.meta)
    processors = make_pre_post_processors(config, dataset_stats=data.meta.stats)
    if crop:
        processors[0].steps = [crop, *processors[0].steps]
    return policy, processors, _pictures(data, processors[0])


def _pictures(data: LeRobotDataset, preprocessor: Any) -> dict[str, Tensor]:
    frames = [data[index] for index in torch.randperm(len(data))[:_N_FRAMES].tolist()]
    kept = [key for key in frames[0] if key.startswith(f"{OBS_STR}.")]
    batch = preprocessor({key: torch.stack([frame[key] for frame in frames]) for key in kept})
    return {key: batch[key] for key in kept if key.startswith(OBS_IMAGES)}


def alike(pictures: Iterable[Tensor]) -> Tensor:
    """Pictures of several sizes as one batch, (B, 3, H, W): all are shrunk to the smallest size."""
    batches = list(pictures)
    size = min(tuple(batch.shape[-2:]) for batch in batches)
    return torch.cat([functional.interpolate(batch, size, mode="area") for batch in batches])


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("folder", type=Path, help="of the checkpoint that is made")
    parser.add_argument("options", nargs="*", help="of ACT, NAME=VALUE; pretrained_backbone_weights=null is added")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--crop", nargs="*", default=[], help="CAMERA=TOP,LEFT,HEIGHT,WIDTH [pixels]")
    parser.add_argument("--size", type=int, help="to which all pictures are resized [pixels]")
    given = parser.parse_args()
    options = list(dict.fromkeys(["pretrained_backbone_weights=null", *given.options]))
    cuts = {
        f"{OBS_IMAGES}.{name}": [int(x) for x in cut.split(",")] for name, cut in (c.split("=") for c in given.crop)
    }
    crop = ImageCropResizeProcessorStep(cuts, given.size and [given.size] * 2) if cuts or given.size else None
    saved_start(options, given.dataset, given.folder, given.seed, crop)
    policy, _, pictures = _prepared(options, given.dataset, given.seed, crop)
    backbone = policy.model.backbone
    mean, deviation = (torch.tensor(IMAGENET_STATS[name]) for name in ("mean", "std"))
    stats = LeRobotDataset(f"experiments/{given.dataset.name}", root=given.dataset, video_backend="pyav").meta.stats
    calibrated = ACTPolicy.from_pretrained(given.folder).model.backbone
    for key, images in pictures.items():
        own = [torch.as_tensor(stats[key][name]).float() for name in ("mean", "std")]
        as_imagenet = (images * own[1] + own[0] - mean) / deviation
        print(f"{key}: {difference(backbone, as_imagenet):.2f} with ImageNet's normalisation", end=", ")
        print(f"{difference(backbone, images):.2f} with the dataset's", end=", ")
        print(f"{difference(calibrated, images):.2f} with these norms")


if __name__ == "__main__":
    main()
