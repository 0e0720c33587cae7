"""What the policy remembers of its last frames, and the action that follows from it."""

import math

import torch
from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.fusion import mlp

_KEY_SIZE = 16


class DisplacementAttention(nn.Module):
    """Reads how far away the arm was at remembered moments: multi-head attention whose values are displacements.

    What an LSTM has to carry along through every step, and blurs, is here one weighted mean of what was measured. The query is
    the LSTM's output, keys are the frames' joint encodings and their ages.

    Args:
        n_heads: Moments that are read at once.
        n_steps: Remembered frames, H.
        size: Numbers of a joint encoding, and of the LSTM's output.
        n_compared: Numbers of a displacement.
    """

    def __init__(self, n_heads: int, n_steps: int, size: int, n_compared: int):
        super().__init__()
        self.n_heads = n_heads
        self.query, self.key = nn.Linear(size, n_heads * _KEY_SIZE), nn.Linear(size, n_heads * _KEY_SIZE)
        self.age = nn.Parameter(torch.zeros(n_heads, n_steps))
        self.read = nn.Linear(n_heads * n_compared, size)

    def forward(self, memories: Tensor, fused: Tensor, displacement: Tensor) -> Tensor:
        """The LSTM's outputs with what is read.

        Args:
            memories: (N, size), the LSTM's outputs.
            fused: (N, H, size), joint encodings of the frames of each.
            displacement: (N, H, n_compared), of each frame from the newest one.

        Returns:
            (N, size).
        """
        query = self.query(memories).unflatten(1, (self.n_heads, _KEY_SIZE))  # (N, heads, key size)
        key = self.key(fused).unflatten(2, (self.n_heads, _KEY_SIZE))  # (N, H, heads, key size)
        scores = torch.einsum("nak,nhak->nah", query, key) / math.sqrt(_KEY_SIZE) + self.age
        with torch.autocast(memories.device.type, enabled=False):  # bfloat16 would round displacements to a millimetre
            heard_there = scores.float().softmax(dim=2) @ displacement.float()  # (N, heads, n_compared)
        return memories + self.read(heard_there.flatten(1))


class MemoryHead(nn.Module):
    """One-layer LSTM over a window of frames, fresh for every window, and an MLP from its last output.

    Of every frame it reads the joint encoding (the paper) and, with `memory_displacement_gain`, how far what the arm measured
    then is from what it measures now. Without that the LSTM has to find a way of centimetres as the difference of two places
    that it knows in units of the whole workspace. With `memory_attention_heads` it also reads such ways beside the LSTM.

    In comments: B items, K windows of H frames, D numbers of a frame: the joint encoding and the displacement.

    Args:
        config: The policy's configuration.
        n_actions: Numbers of an action.
        n_felt: Of all low-dimensional observations of a frame together.
    """

    def __init__(self, config: PlaybyearConfig, n_actions: int, n_felt: int):
        super().__init__()
        self.memory_steps, self.action_range = config.memory_steps, config.action_range
        self.displacement_gain = config.memory_displacement_gain / config.low_dimensional_gain
        self.n_fused = config.embedding_size
        n_compared = n_felt if self.displacement_gain else 0
        self.lstm = nn.LSTM(self.n_fused + n_compared, config.embedding_size, batch_first=True)
        self.head = mlp(config.embedding_size, config.hidden_size, n_actions)
        heads = config.memory_attention_heads if n_compared else 0
        self.attention = DisplacementAttention(heads, self.memory_steps, self.n_fused, n_compared) if heads else None

    def with_felt(self, fused: Tensor, felt: list[Tensor]) -> Tensor:
        """What is kept of frames: their joint encodings (N, embedding size), and with displacements what was felt, (N, D)."""
        return torch.cat([fused, *felt], dim=-1) if self.displacement_gain else fused

    def forward(self, encodings: Tensor) -> Tensor:
        """The action after every full window of consecutive frames, (B, n, D).

        Returns:
            (B, K, n_actions) with K = n - H + 1, in [-1, 1] times the action range.
        """
        return self.act(self.recall(encodings))

    def recall(self, encodings: Tensor) -> Tensor:
        """(B, n, D) consecutive frames -> (B, K, embedding size), the memory's output after every full window."""
        windows = encodings.unfold(1, self.memory_steps, 1).transpose(2, 3)  # (B, K, H, D)
        if self.displacement_gain:
            felt = windows[..., self.n_fused :]
            displacement = self.displacement_gain * (felt - felt[:, :, -1:])
            windows = torch.cat([windows[..., : self.n_fused], displacement], dim=-1)
        frames = windows.flatten(0, 1)  # (B * K, H, D)
        memories = self.lstm(frames)[0][:, -1]  # (B * K, embedding size)
        if self.attention is not None:
            memories = self.attention(memories, *frames.tensor_split([self.n_fused], dim=2))
        return memories.unflatten(0, windows.shape[:2])

    def act(self, memories: Tensor) -> Tensor:
        """(..., embedding size) of `recall` -> (..., n_actions)."""
        actions = self.head(memories.flatten(0, -2)).float()  # whatever autocast computed in
        actions = self.action_range * torch.tanh(actions / self.action_range)
        return actions.unflatten(0, memories.shape[:-1])
