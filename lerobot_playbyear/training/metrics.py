"""The figures of training, as LeRobot keeps them."""

import torch
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker

from lerobot_playbyear.datasets import EpisodeStore


def make_tracker(batch_size: int, store: EpisodeStore, step: int = 0) -> MetricsTracker:
    """The averages that LeRobot's `update_policy` writes to.

    Args:
        batch_size: Items per update.
        store: What they are drawn from.
        step: Updates done before.
    """
    meters = {
        "loss": AverageMeter("loss", ":.3f"),
        "grad_norm": AverageMeter("grdn", ":.3f"),
        "lr": AverageMeter("lr", ":0.1e"),
        "update_s": AverageMeter("updt_s", ":.3f"),
        "dataloading_s": AverageMeter("data_s", ":.3f"),
    }
    if torch.cuda.is_available():
        meters["gpu_mem_gb"] = AverageMeter("mem_gb", ":.2f")
    return MetricsTracker(batch_size, len(store), store.n_episodes, meters, initial_step=step)
