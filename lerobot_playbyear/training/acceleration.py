"""What makes updates faster and changes nothing that is learned (docs/scale.md)."""

import ctypes
import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.networks import VisionEncoder

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # glibc's malloc.h
_TOP_PAD = 256 * 2**20  # bytes
_DIMENSIONS = 4  # of a convolution's weights


def keep_freed_memory() -> bool:
    """Makes glibc keep freed memory for the next update instead of giving it back to the system after every one.

    The network's intermediate results are megabytes each and are freed at every update; handing their pages back and forth
    takes a quarter of an update's time on a CPU. Without glibc nothing happens.

    Returns:
        Whether it was done.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, _TOP_PAD))
    return all(mallopt(parameter, value) == 1 for parameter, value in settings)


def prefer_channels_last(policy: nn.Module, optimizer: Optimizer) -> None:
    """Lays the weights of convolutions out as a GPU's tensor cores read them, and the optimizer's state with them.

    Checkpoints stay as they are: safetensors saves contiguous tensors alone, and so the optimizer hands its state out.

    Args:
        policy: Whatever learns.
        optimizer: Of its parameters; it may have a state already.
    """
    policy.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer.register_state_dict_post_hook(_contiguous)
    optimizer.register_load_state_dict_post_hook(_like_parameters)
    _like_parameters(optimizer)


def fuse(optimizer: Optimizer) -> None:
    """Makes Adam's step one kernel. Its state need not lie on the host, so nothing waits for it.

    Checkpoints do not say so: LeRobot resumes none whose options have other types than the optimizer's, which were not set.
    """
    if not isinstance(optimizer, Adam):
        return
    optimizer.register_state_dict_post_hook(_as_if_not_fused)
    optimizer.register_load_state_dict_post_hook(_fused)
    _fused(optimizer)


def compile_networks(policy: nn.Module) -> None:
    """Compiles the encoders and the head of a policy `playbyear` when they are first used; names of weights stay.

    Raises:
        ValueError: The policy is another one.
    """
    if not isinstance(policy, PlaybyearPolicy):
        raise ValueError("--compile=true is for --policy.type=playbyear: leave it out.")
    network = policy.model
    parts: list[nn.Module] = [network.fusion, network.memory_head.head]
    parts += [encoder.network for encoder in network.modules() if isinstance(encoder, VisionEncoder)]
    if policy.config.use_audio:
        parts += network.hearing.values()
    for part in parts:
        part.compile()


def _contiguous(_: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    def saved(values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value.contiguous() if isinstance(value, Tensor) else value for key, value in values.items()}

    return {**state, "state": {number: saved(values) for number, values in state["state"].items()}}


def _like_parameters(optimizer: Optimizer) -> None:
    for parameter, values in optimizer.state.items():
        for key, value in values.items():
            if isinstance(value, Tensor) and value.dim() == _DIMENSIONS:
                values[key] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)


def _fused(optimizer: Optimizer) -> None:
    for group in optimizer.param_groups:
        group["fused"] = True
        for parameter in group["params"]:
            state = optimizer.state.get(parameter, {})
            if "step" in state:
                state["step"] = state["step"].to(parameter.device)


def _as_if_not_fused(_: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "param_groups": [{**group, "fused": None} for group in state["param_groups"]]}
