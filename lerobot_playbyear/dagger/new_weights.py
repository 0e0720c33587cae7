"""A policy that begins anew: all that it has learned is forgotten, but for what its inputs are normalised with."""

from typing import Any

import torch
from lerobot.utils.random_utils import set_seed

from lerobot_playbyear.training.parts import TrainingParts


@torch.no_grad()
def forget_all(parts: TrainingParts, seed: int) -> None:
    """Gives a policy the weights of one that was just made. Its normalisation stays, of sound too.

    Args:
        parts: What learns; no update was made yet.
        seed: Of the weights.
    """
    policy: Any = parts.accelerator.unwrap_model(parts.policy)
    set_seed(seed)
    fresh = type(policy)(policy.config).state_dict()
    kept = [f"{name}." for name, module in policy.named_modules() if getattr(module, "keeps_statistics", False)]
    weights = policy.state_dict()
    for name, values in fresh.items():
        if not any(name.startswith(prefix) for prefix in kept):
            weights[name].copy_(values)
