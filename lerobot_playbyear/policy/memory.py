"""What the policy remembers of its last frames, and the action that follows from it."""

import torch
from torch import Tensor, nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.fusion import mlp

_SHARPNESS = 4.0  # a choice among frames is learned in as few updates as the rest


class MemoryHead(nn.Module):
    """One-layer LSTM over a window of frames, fresh for every window, and an MLP from its last output.

    Of every frame it reads the joint encoding (the paper) and, with `memory_displacement_gain`, how far what the arm measured
    then is from what it measures now. Without that the LSTM has to find a way of centimetres as the difference of two places
    that it knows in units of the whole workspace.

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
        self.recollection = None
        if config.memory_readers and n_compared:
            self.recollection = Recollection(config.memory_readers, self.n_fused, n_compared, self.memory_steps)

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
        outputs, _ = self.lstm(windows.flatten(0, 1))  # (B * K, H, embedding size)
        remembered = outputs[:, -1].unflatten(0, windows.shape[:2])
        if self.recollection is None:
            return remembered
        return remembered + self.recollection(encodings[..., : self.n_fused], windows[..., self.n_fused :])

    def act(self, memories: Tensor) -> Tensor:
        """(..., embedding size) of `recall` -> (..., n_actions)."""
        actions = self.head(memories.flatten(0, -2)).float()  # whatever autocast computed in
        actions = self.action_range * torch.tanh(actions / self.action_range)
        return actions.unflatten(0, memories.shape[:-1])


class Recollection(nn.Module):
    """Reads, of the frames that it chooses by what was seen and heard in them, how far the arm was from where it is now.

    An LSTM has to carry such a length through all later frames, and hops of six centimetres end millimetres beside the cube.
    Here each of M readers gives every frame of the window a weight (a softmax over frames, of its
    joint encoding and of how long ago it was), and the mean of the displacements is added to what the LSTM remembers.

    Args:
        n_readers: M.
        n_fused: Of a joint encoding.
        n_compared: Of a displacement.
        n_steps: Frames in a window, H.
    """

    def __init__(self, n_readers: int, n_fused: int, n_compared: int, n_steps: int):
        super().__init__()
        self.score = nn.Linear(n_fused, n_readers)
        self.recency = nn.Parameter(torch.zeros(n_readers, n_steps))
        self.read = nn.Linear(n_readers * n_compared, n_fused, bias=False)
        # Displacements are tens of units: other weights drive the actions' tanh to its ends.
        nn.init.zeros_(self.read.weight)

    def forward(self, fused: Tensor, displacement: Tensor) -> Tensor:
        """Joint encodings (B, n, D) and every window's displacements (B, K, H, numbers) -> (B, K, D)."""
        scores = _SHARPNESS * self.score(fused).unfold(1, displacement.shape[2], 1)  # (B, K, M, H)
        weights = (scores + self.recency).softmax(dim=-1)
        return self.read((weights @ displacement).flatten(2))
