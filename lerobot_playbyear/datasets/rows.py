"""Rows of a store's columns: in LeRobot's dtypes, on its device, and written behind the last ones."""

import numpy as np
import torch
from torch import Tensor

_GROWTH = 1.5


def as_lerobot_has(rows: Tensor) -> Tensor:
    """Stored values in the dtypes of LeRobot's loader: images as floats in [0, 1], integers as int64."""
    if rows.dtype in (torch.bool, torch.float32, torch.int64):
        return rows
    if rows.device.type != "cpu":
        return rows.float() / 255 if rows.dtype == torch.uint8 else rows.long()
    # NumPy converts in one pass and into huge pages: four times faster than PyTorch for a batch of images.
    values = rows.numpy()
    if rows.dtype == torch.uint8:
        return torch.from_numpy(np.divide(values, np.float32(255), dtype=np.float32))
    return torch.from_numpy(values.astype(np.int64))


def sent_to(device: torch.device, values: Tensor) -> Tensor:
    """Small numbers of the host, on a device; nothing waits for them."""
    if device.type == "cuda":
        return values.pin_memory().to(device, non_blocking=True)
    return values.to(device)


def write_rows(values: Tensor, position: int, new: Tensor) -> Tensor:
    """Put `new` at `position`; where there is no room the tensor is copied into one with room to spare."""
    end = position + len(new)
    if end > len(values):
        roomy = values.new_empty((max(end, int(len(values) * _GROWTH)), *values.shape[1:]))
        roomy[:position] = values[:position]
        values = roomy
    values[position:end] = new
    return values
