"""The network's blocks: vision encoder, audio encoder, fusion, memory and head (paper, appendix "Architecture Details")."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock, ResNet

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.packed_encoder import FoldedCopy
from lerobot_playbyear.policy.shared_statistics import SharedBatchNorm2d

_IMAGE_MEAN, _IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_AUDIO_KERNEL = 7
_SINGLE_PIXELS = 16  # stacks up to this size are single pixels before the last stage


class VisionEncoder(nn.Module):
    """ResNet-18 from scratch over channel-wise stacked images, up to the layer before the last.

    Args:
        n_stacked: Images per stack.
        width: Channels of the first stage; 64 is ResNet-18. The embedding has 8 times as many.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, n_stacked: int, width: int):
        super().__init__()
        self.embedding_size = 8 * width
        self.network = _SlimResNet(3 * n_stacked, width)
        self.register_buffer("mean", torch.tensor(_IMAGE_MEAN).repeat(n_stacked)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_IMAGE_STD).repeat(n_stacked)[:, None, None], persistent=False)
        self._folded = FoldedCopy()  # for acting; no part of a checkpoint

    def forward(self, stacks: Tensor) -> Tensor:
        """(N, 3 * n_stacked, size, size) in [0, 1] -> (N, embedding_size)."""
        stacks = (stacks - self.mean) / self.std
        # Activations alone: the optimizer's state of channels_last weights is more than safetensors can save.
        stacks = stacks.contiguous(memory_format=torch.channels_last)
        acts = not self.training and not torch.is_grad_enabled() and self.mean.dtype == torch.float32
        if acts:
            return self._folded.look(self.network, stacks)
        with _precise_if_single_pixels(stacks):
            return self.network(stacks)

    def train(self, mode: bool = True) -> "VisionEncoder":
        """Also forgets what was prepared for acting."""
        if mode:
            self._folded.drop()
        return super().train(mode)

    def refresh(self) -> None:
        """Prepares for acting anew: even a change of weights that passed torch's own count of changes by is seen."""
        self._folded.drop()
        if not self.training and self.mean.dtype == torch.float32:
            self._folded.of(self.network)


def _precise_if_single_pixels(stacks: Tensor) -> AbstractContextManager:
    """Without autocast on a CPU: of a single pixel, oneDNN's bfloat16 gradient of a convolution with stride 2 is random, and is
    written beyond its memory (torch 2.11)."""
    if stacks.device.type == "cpu" and max(stacks.shape[-2:]) <= _SINGLE_PIXELS:
        return torch.autocast("cpu", enabled=False)
    return nullcontext()


class _SlimResNet(ResNet):
    """torchvision's ResNet-18 with another number of input channels and another width, without the classifier."""

    def __init__(self, in_channels: int, width: int):
        super().__init__(BasicBlock, [2, 2, 2, 2], norm_layer=SharedBatchNorm2d)
        self.inplanes = width
        self.conv1 = nn.Conv2d(in_channels, width, kernel_size=7, stride=2, padding=3, bias=False)
        self.bn1 = SharedBatchNorm2d(width)
        self.layer1 = self._make_layer(BasicBlock, width, 2)
        self.layer2 = self._make_layer(BasicBlock, 2 * width, 2, stride=2)
        self.layer3 = self._make_layer(BasicBlock, 4 * width, 2, stride=2)
        self.layer4 = self._make_layer(BasicBlock, 8 * width, 2, stride=2)
        self.fc = nn.Identity()
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")


class AudioEncoder(nn.Module):
    """Convolutions over time, frequency bins as channels.

    Args:
        n_bins: Frequency bins.
        n_segments: Columns of the spectrogram.
        channels: Output channels of each convolution.
    """

    def __init__(self, n_bins: int, n_segments: int, channels: tuple[int, ...]):
        super().__init__()
        length = n_segments - len(channels) * (_AUDIO_KERNEL - 1)
        if length < 1:
            raise ValueError(
                f"audio_window_s holds {n_segments} segments, too few for {len(channels)} convolutions of kernel "
                f"{_AUDIO_KERNEL}: at least {1 + len(channels) * (_AUDIO_KERNEL - 1)} are needed."
            )
        layers: list[nn.Module] = []
        for n_in, n_out in zip((n_bins, *channels), channels, strict=False):
            layers += [nn.Conv1d(n_in, n_out, _AUDIO_KERNEL), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.length, self.embedding_size = length, channels[-1] * length

    def forward(self, spectrogram: Tensor) -> Tensor:
        """(N, n_bins, n_segments + extra) -> (N, channels[-1], length + extra), embeddings before they are flattened.

        Extra segments belong to later windows of the same sound; their embeddings are slices of the result.
        """
        return self.layers(spectrogram)


def _mlp(n_in: int, hidden: int, n_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n_out)
    )


class Fusion(nn.Module):
    """MLP with two hidden layers from all encodings of a frame to one joint encoding z."""

    def __init__(self, n_in: int, config: PlaybyearConfig):
        super().__init__()
        self.layers = _mlp(n_in, config.hidden_size, config.embedding_size)

    def forward(self, encodings: list[Tensor]) -> Tensor:
        """[(N, ...)] -> (N, D)."""
        return self.layers(torch.cat(encodings, dim=-1))


class MemoryHead(nn.Module):
    """One-layer LSTM over a window of joint encodings, fresh for every window, and an MLP from its last output."""

    def __init__(self, config: PlaybyearConfig, n_actions: int):
        super().__init__()
        self.memory_steps, self.action_range = config.memory_steps, config.action_range
        self.lstm = nn.LSTM(config.embedding_size, config.embedding_size, batch_first=True)
        self.head = _mlp(config.embedding_size, config.hidden_size, n_actions)

    def forward(self, encodings: Tensor) -> Tensor:
        """The action after every full window.

        Args:
            encodings: (B, R, D) consecutive frames' joint encodings.

        Returns:
            (B, R - H + 1, n_actions), in [-1, 1] times the action range.
        """
        windows = encodings.unfold(1, self.memory_steps, 1).transpose(2, 3)  # (B, K, H, D)
        n_items, n_windows = windows.shape[:2]
        outputs, _ = self.lstm(windows.flatten(0, 1))  # (B * K, H, D)
        actions = self.head(outputs[:, -1]).float()  # whatever autocast computed in
        actions = self.action_range * torch.tanh(actions / self.action_range)
        return actions.unflatten(0, (n_items, n_windows))
