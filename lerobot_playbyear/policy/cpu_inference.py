"""The vision encoder as a processor is fastest at it: acting with folded batch norm and packed convolutions, learning from
pictures that lie in memory as convolutions read them.

Attached from outside, after the network was made: the same function, the same names in a checkpoint.
"""

import copy
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torchvision.models import ResNet

from lerobot_playbyear import compat
from lerobot_playbyear.compat import BasicBlock, n_changes
from lerobot_playbyear.policy.networks import VisionEncoder
from lerobot_playbyear.policy.optimization import HAS_512_BITS

_PAIRS = (("conv1", "bn1"), ("conv2", "bn2"))  # torchvision's names in a ResNet and in its blocks
_SMALLEST = 32  # pixels: their last maps are 1x1, whose order in memory oneDNN cannot tell
_SINGLE_PIXELS = 16  # stacks up to this size are single pixels before the last stage
_IN_CACHE = 16  # stacks of small pictures that a processor's cache holds
_SAFE_EMBEDDING = 64  # 8 channels in the first stage, and multiples of them


def act_by_folded_copies(network: nn.Module) -> None:
    """Lets every `VisionEncoder` in a network act by a copy of itself; the names in its `state_dict` stay."""
    for parent in list(network.modules()):
        for name, encoder in parent.named_children():
            if type(encoder) is VisionEncoder:
                parent.register_module(name, FoldedVisionEncoder(encoder))


def prepare_to_act(network: nn.Module) -> None:
    """Makes the copies again: even a change of weights that passed torch's own count of changes by is seen."""
    for module in network.modules():
        if isinstance(module, FoldedVisionEncoder):
            module.refresh()


class FoldedVisionEncoder(VisionEncoder):
    """A vision encoder that learns as what it is, and acts by a folded and packed copy of itself.

    Args:
        plain: The encoder whose parts it takes over.
    """

    def __init__(self, plain: VisionEncoder) -> None:
        nn.Module.__init__(self)
        self.embedding_size, self.network = plain.embedding_size, plain.network
        self.register_buffer("mean", plain.mean, persistent=False)
        self.register_buffer("std", plain.std, persistent=False)
        self._folded = FoldedCopy()  # no part of a checkpoint

    def forward(self, stacks: Tensor) -> Tensor:
        """(N, 3 * n_stacked, size, size) in [0, 1] -> (N, embedding_size)."""
        if self._can_act() and not torch.is_grad_enabled():
            return self._folded.look(self.network, self.normalize(stacks))
        # Of a single pixel, oneDNN's bfloat16 gradient of a convolution with stride 2 is random, and is written beyond its
        # memory (torch 2.11).
        is_pixel = stacks.device.type == "cpu" and max(stacks.shape[-2:]) <= _SINGLE_PIXELS
        with torch.autocast("cpu", enabled=False) if is_pixel else nullcontext():
            return super().forward(stacks)

    def normalize(self, stacks: Tensor) -> Tensor:
        """The same as channels_last, a few stacks at a time."""
        on_cpu = stacks.device.type == "cpu"
        if on_cpu and self.embedding_size % _SAFE_EMBEDDING and not HAS_512_BITS:
            return super().normalize(stacks)  # oneDNN writes gradients of 4 channels beyond their memory (torch 2.11)
        # Activations alone: the optimizer's state of channels_last weights is more than safetensors can save.
        normalized = torch.empty_like(stacks, memory_format=torch.channels_last)
        together = _IN_CACHE if on_cpu and not torch.compiler.is_compiling() else max(1, len(stacks))
        for part, place in zip(stacks.split(together), normalized.split(together), strict=True):
            place.copy_((part - self.mean).div_(self.std))
        return normalized

    def train(self, mode: bool = True) -> "FoldedVisionEncoder":
        """Also forgets what was prepared for acting."""
        if mode:
            self._folded.drop()
        return super().train(mode)

    def refresh(self) -> None:
        """Prepares for acting again."""
        self._folded.drop()
        if self._can_act():
            self._folded.of(self.network)

    def _can_act(self) -> bool:
        return not self.training and self.mean.dtype == torch.float32


def fold_batch_norm(network: ResNet) -> ResNet:
    """A copy of a ResNet that computes the same in eval mode, to float precision, in half the operations.

    Its weights lie in memory as the convolutions read them (channels_last), which otherwise is done over at every call.
    """
    folded = copy.deepcopy(network).eval()
    for module in list(folded.modules()):
        pairs = [pair for pair in _PAIRS if hasattr(module, pair[0])]
        if isinstance(module, nn.Sequential) and len(module) == 2 and isinstance(module[1], nn.BatchNorm2d):
            pairs.append(("0", "1"))  # a shortcut
        for name, norm_name in pairs:
            convolution, norm = module.get_submodule(name), module.get_submodule(norm_name)
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(norm, nn.BatchNorm2d)
            module.register_module(name, fuse_conv_bn_eval(convolution, norm))
            module.register_module(norm_name, nn.Identity())
    folded.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return folded


class PackedResNet:
    """The forward pass of a folded ResNet on a CPU, by oneDNN's convolutions as torch's own compiler calls them.

    Weights are packed once, as the convolution of the first size seen reads them; ReLU and the shortcut's sum are part of
    the convolution. PyTorch by itself packs at every call, makes passes of their own of both, and takes another, slower
    convolution for single small pictures.

    Args:
        folded: Of `fold_batch_norm`.
    """

    def __init__(self, folded: ResNet) -> None:
        # Looked up now: they are not in every build of torch.
        self._pack, self._convolution = compat.reorder_convolution_weight, compat.convolution_pointwise
        self._convolution_and_sum = compat.convolution_pointwise_binary
        self._network = folded
        self._weights: dict[nn.Module, Tensor] = {}

    @staticmethod
    def suits(stacks: Tensor) -> bool:
        """Whether it can look at this, on this machine."""
        is_plain = stacks.device.type == "cpu" and stacks.dtype == torch.float32 and min(stacks.shape[-2:]) > _SMALLEST
        has_library = torch.backends.mkldnn.is_available() and bool(torch.backends.mkldnn.enabled)
        return is_plain and has_library and not torch.is_autocast_enabled("cpu")

    def __call__(self, stacks: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, embedding size)."""
        network = self._network
        maps = network.maxpool(self._convolve(network.conv1, stacks, "relu"))
        for layer in (network.layer1, network.layer2, network.layer3, network.layer4):
            for block in layer:
                assert isinstance(block, BasicBlock)
                inner = self._convolve(block.conv1, maps, "relu")
                if block.downsample is not None:
                    maps = self._convolve(block.downsample[0], maps, "none")
                maps = self._convolve(block.conv2, inner, "relu", plus=maps)
        return network.avgpool(maps).flatten(1)

    def _convolve(self, module: nn.Module, maps: Tensor, then: str, plus: Tensor | None = None) -> Tensor:
        assert isinstance(module, nn.Conv2d)
        geometry = list(module.padding), list(module.stride), list(module.dilation), module.groups
        if module not in self._weights:
            with torch.inference_mode(False), torch.no_grad():
                self._weights[module] = self._pack(module.weight.detach(), *geometry, list(maps.shape))
        packed = self._weights[module], module.bias, *geometry
        if plus is None:
            return self._convolution(maps, *packed, then, [], "")
        return self._convolution_and_sum(maps, plus, *packed, "add", 1.0, then, [], "")


class FoldedCopy:
    """Keeps the folded copy of a network, and makes a new one when the network's weights are no longer those it was made of."""

    def __init__(self) -> None:
        self._copy: ResNet | None = None
        self._packed: PackedResNet | None = None
        self._made_of: tuple[tuple[int, int], ...] = ()

    def of(self, network: ResNet) -> ResNet:
        """The folded copy of a network as it is now."""
        # Where every weight lies and how often it was changed: other after every update, loading and move to a device.
        weights = tuple((each.data_ptr(), n_changes(each)) for each in (*network.parameters(), *network.buffers()))
        if self._copy is None or weights != self._made_of:
            self.drop()
            with torch.inference_mode(False), torch.no_grad():
                self._copy, self._made_of = fold_batch_norm(network), weights
        return self._copy

    def look(self, network: ResNet, stacks: Tensor) -> Tensor:
        """What a network as it is now makes of stacks, (N, C, H, W) -> (N, embedding size), the fastest way."""
        folded = self.of(network)
        if not PackedResNet.suits(stacks):
            return folded(stacks)
        if self._packed is None:
            self._packed = PackedResNet(folded)
        return self._packed(stacks)

    def drop(self) -> None:
        """Forgets the copy."""
        self._copy = self._packed = None

    def __getstate__(self) -> dict[str, Any]:
        """Of a copy or a pickle: nothing, for it belongs to another network."""
        return vars(FoldedCopy())
