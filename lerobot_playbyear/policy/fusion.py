"""From all encodings of a frame to one joint encoding z: by concatenation (the paper), or by attention among them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

_TOKEN_SIZE, _N_HEADS = 128, 4  # of the attention


class Fusion(nn.Module):
    """MLP with two hidden layers from all encodings of a frame to one joint encoding z.

    Args:
        sizes: Numbers in each encoding: of every camera, every microphone and every low-dimensional observation.
        config: The policy's configuration.
    """

    def __init__(self, sizes: Sequence[int], config: PlaybyearConfig):
        super().__init__()
        self.layers = mlp(sum(sizes), config.hidden_size, config.embedding_size)
        self.drop = nn.Dropout(config.fusion_dropout) if config.fusion_dropout else nn.Identity()

    def forward(self, encodings: list[Tensor]) -> Tensor:
        """[(N, ...)] -> (N, D)."""
        return self.drop(self.layers(torch.cat(encodings, dim=-1)))


class AttentionFusion(nn.Module):
    """One multi-head attention among the encodings of a frame, each a token; the MLP gets the tokens' mean.

    After the attention among vision, touch and sound of Li et al., "See, Hear, and Feel" (CoRL 2022), which concatenates
    afterwards.

    Args:
        sizes: As for `Fusion`.
        config: The policy's configuration.
    """

    def __init__(self, sizes: Sequence[int], config: PlaybyearConfig):
        super().__init__()
        self.tokens = nn.ModuleList(nn.Linear(size, _TOKEN_SIZE) for size in sizes)  # biases tell the senses apart
        self.attention = nn.MultiheadAttention(_TOKEN_SIZE, _N_HEADS, batch_first=True)
        self.layers = mlp(_TOKEN_SIZE, config.hidden_size, config.embedding_size)
        self.drop = nn.Dropout(config.fusion_dropout) if config.fusion_dropout else nn.Identity()

    def forward(self, encodings: list[Tensor]) -> Tensor:
        """[(N, ...)] -> (N, D)."""
        pairs = zip(self.tokens, encodings, strict=True)
        tokens = torch.stack([linear(encoding) for linear, encoding in pairs], dim=1)  # (N, senses, token size)
        attended, _ = self.attention(tokens, tokens, tokens, need_weights=False)
        return self.drop(self.layers((tokens + attended).mean(dim=1)))


FUSIONS: dict[str, type[Fusion] | type[AttentionFusion]] = {"concatenation": Fusion, "attention": AttentionFusion}
"""By the values of `--policy.fusion`."""


def mlp(n_in: int, hidden: int, n_out: int) -> nn.Sequential:
    """Two hidden layers: (N, n_in) -> (N, n_out)."""
    return nn.Sequential(
        nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n_out)
    )
