"""The number format of training: what was asked for, and what a device can do."""

import logging
from collections.abc import Mapping

import torch

DTYPES = ("auto", "float32", "bfloat16", "float16")
"""What `--policy.dtype` can be."""


def training_dtype(asked: str | None, use_amp: bool, device: str) -> str | None:
    """The format that LeRobot's training computes in, by autocast; weights and the optimizer stay float32.

    Args:
        asked: One of `DTYPES`. None leaves it to `use_amp`.
        use_amp: As in LeRobot's policies: the 16-bit format that PyTorch takes on the device; on an NVIDIA GPU bfloat16
            where it has it.
        device: Where training takes place.

    Returns:
        "float32", "bfloat16" or "float16"; None where nothing was asked for, which leaves it to `accelerate launch`.
    """
    kind = torch.device(device).type
    if asked is None and use_amp:
        asked = "auto" if kind == "cuda" else str(torch.get_autocast_dtype(kind)).removeprefix("torch.")
    if asked == "auto":
        return _fastest(kind)
    if asked is not None and not _computes(kind, asked):
        logging.warning(f"The device '{device}' cannot train in {asked}: --policy.dtype is float32 here.")
        return "float32"
    return asked


def computes_bfloat16() -> bool:
    """Whether this CPU multiplies in bfloat16 by itself; elsewhere autocast costs more time than it saves."""
    return _has_any("avx512_bf16", "amx_bf16")


def computes_512_bits() -> bool:
    """Whether this CPU has AVX-512."""
    return _has_any("avx512_f")


def _has_any(*names: str) -> bool:
    capabilities: Mapping[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in names)


def _fastest(kind: str) -> str:
    if kind == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float16"
    return "bfloat16" if kind == "cpu" and computes_bfloat16() else "float32"


def _computes(kind: str, dtype: str) -> bool:
    """Whether `accelerate` takes a format on a device; Apple's GPUs are left at float32, as LeRobot leaves them."""
    if dtype == "bfloat16":
        return kind in ("cpu", "xpu") or (kind == "cuda" and torch.cuda.is_bf16_supported())
    return dtype == "float32" or kind in ("cuda", "xpu")
