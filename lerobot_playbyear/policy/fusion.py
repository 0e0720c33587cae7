"""From all encodings of a frame to one joint encoding z, by concatenation."""

import torch
from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


class Fusion(nn.Module):
    """MLP with two hidden layers from all encodings of a frame to one joint encoding z.

    Args:
        size: Numbers in all encodings together: of cameras, microphones and low-dimensional observations.
        config: The policy's configuration.
    """

    def __init__(self, size: int, config: PlaybyearConfig):
        super().__init__()
        self.layers = mlp(size, config.hidden_size, config.embedding_size)

    def forward(self, encodings: list[Tensor]) -> Tensor:
        """[(N, ...)] -> (N, D)."""
        return self.layers(torch.cat(encodings, dim=-1))


def mlp(n_in: int, hidden: int, n_out: int) -> nn.Sequential:
    """Two hidden layers: (N, n_in) -> (N, n_out)."""
    return nn.Sequential(
        nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n_out)
    )
