"""HG-DAgger in several processes: the first one collects and draws, and all of them learn from its batches."""

import logging
import os

import torch
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.new_weights import forget_all
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.parts import make_training_parts


def is_first_process() -> bool:
    """Whether this is the process that collects, as `accelerate launch` says it; without it there is no other."""
    return os.environ.get("RANK", "0") == "0"


def help_to_learn(cfg: DaggerConfig, training: PlaybyearTrainConfig) -> None:
    """Makes the same updates as the first process, each on its own share of the batch, until there are no more.

    Args:
        cfg: The options.
        training: Those of playbyear-train that follow from them.
    """
    from lerobot_playbyear.training.processes import Orders

    logging.getLogger().setLevel(logging.ERROR)
    parts = make_training_parts(
        training, LeRobotDatasetMetadata(cfg.demos.repo_id, cfg.demos.root), keep_normalization=True
    )
    if cfg.new_weights and not training.resume:
        forget_all(parts, cfg.seed)  # as the first process does: they are told of gradients, not of weights
    orders = Orders(parts.accelerator)
    while order := orders.take():
        if order["seed"] is not None:
            torch.manual_seed(order["seed"] + parts.accelerator.process_index)
        for group in parts.optimizer.param_groups:
            group["lr"] = order["rate"]
        parts.update(order["batch"], order["grad_clip_norm"])
