"""Pictures brought to the size at which a policy looks at them, before they are kept."""

from collections.abc import Sequence

import numpy as np
import torch
from torch.nn import functional


def shrunk_size(height: int, width: int, image_size: int) -> tuple[int, int]:
    """The height and width at which pictures are kept: at most `image_size` each [pixels]."""
    return min(height, image_size), min(width, image_size)


def kept_shape(shape: Sequence[int], image_size: int | None) -> tuple[int, int, int]:
    """The channels, height and width of a camera's pictures where they are kept.

    Args:
        shape: Of the feature, (C, H, W) or (H, W, C).
        image_size: Largest height and width kept [pixels]; None: as they are recorded.
    """
    channels, height, width = shape if shape[0] in (1, 3) else (shape[2], *shape[:2])
    if image_size is not None:
        height, width = shrunk_size(height, width, image_size)
    return channels, height, width


def shrink(pictures: np.ndarray, image_size: int) -> np.ndarray:
    """Shrinks pictures as the policy `playbyear` does: every pixel is the weighted mean of those that it covers.

    Args:
        pictures: (n, C, H, W) uint8.
        image_size: Largest height and width wanted [pixels].

    Returns:
        (n, C, h, w) uint8, `pictures` themselves where they are no larger. They differ from what the policy makes of the
        recorded ones by rounding, one level of 255.
    """
    height, width = pictures.shape[-2:]
    size = shrunk_size(height, width, image_size)
    if size == (height, width):
        return pictures
    values = torch.from_numpy(np.ascontiguousarray(pictures.transpose(0, 2, 3, 1))).permute(0, 3, 1, 2)
    return functional.interpolate(values, size, mode="bilinear", align_corners=False, antialias=True).numpy()
