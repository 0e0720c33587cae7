"""Images into the vision encoder: augmentation and resizing in one sampling pass."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

# Colour as luma and two chroma components (NTSC); turning the chroma plane turns the hue.
_YIQ = torch.tensor([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


class Augmentation(nn.Module):
    """Draws a change of colour and of position per run. It learns nothing; its constants lie where the images do.

    Args:
        config: Of the policy, with its strengths.
    """

    yiq: Tensor
    rgb: Tensor

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        self.config = config
        # Buffers, for a copy to the device at every update would make the host wait for it.
        self.register_buffer("yiq", _YIQ.clone(), persistent=False)
        self.register_buffer("rgb", torch.linalg.inv(_YIQ), persistent=False)

    def forward(self, images: Tensor, size: int, recorded: tuple[int, ...] | None = None) -> Tensor:
        """Augments runs of images and resizes them; all images of a run get the same draw.

        Args:
            images: (B, T, 3, H, W) in [0, 1].
            size: Height and width wanted [pixels].
            recorded: Height and width of the camera's pictures [pixels], which `images` may be shrunk from.

        Returns:
            (B, T, 3, size, size).
        """
        height, width = images.shape[-2:]
        if height > size or width > size:  # first: there is less to recolour, the same but where a colour saturates
            images = resize(images, size)
        return self._warp(self._recolour(images), size, recorded or (height, width))

    def _recolour(self, images: Tensor) -> Tensor:
        config, n_runs, device = self.config, images.shape[0], images.device
        brightness = 1 + config.augmentation_brightness * _uniform(n_runs, device)
        angle = 2 * math.pi * config.augmentation_hue * _uniform(n_runs, device)
        turn = torch.zeros(n_runs, 3, 3, device=device)
        turn[:, 0, 0] = 1
        turn[:, 1, 1] = turn[:, 2, 2] = angle.cos()
        turn[:, 2, 1], turn[:, 1, 2] = angle.sin(), -angle.sin()
        matrix = brightness[:, None, None] * (self.rgb.float() @ turn @ self.yiq.float())  # (B, 3, 3)
        flat = images.transpose(1, 2).flatten(2)  # (B, 3, T * H * W)
        recoloured = (matrix.to(images.dtype) @ flat).clamp_(0, 1)
        return recoloured.view(images.shape[0], 3, images.shape[1], *images.shape[3:]).transpose(1, 2)

    def _warp(self, images: Tensor, size: int, original: tuple[int, ...]) -> Tensor:
        config, device = self.config, images.device
        n_runs, n_frames = images.shape[:2]
        height, width = original
        angle = math.radians(config.augmentation_degrees) * _uniform(n_runs, device)
        scale = 1 / (1 + config.augmentation_scale * _uniform(n_runs, device))
        theta = torch.zeros(n_runs, 2, 3, device=device)
        theta[:, 0, 0] = theta[:, 1, 1] = scale * angle.cos()
        # In pixels a rotation, in coordinates from -1 to 1 only where the image is square.
        theta[:, 0, 1] = -scale * angle.sin() * height / width
        theta[:, 1, 0] = scale * angle.sin() * width / height
        # Coordinates run from -1 to 1: a shift of the whole size is 2.
        crop, translate = config.augmentation_crop, config.augmentation_translate
        shift_x = translate * _uniform(n_runs, device) + crop / width * _uniform(n_runs, device)
        shift_y = translate * _uniform(n_runs, device) + crop / height * _uniform(n_runs, device)
        theta[:, 0, 2], theta[:, 1, 2] = 2 * shift_x, 2 * shift_y
        grid = functional.affine_grid(theta, [n_runs, 1, size, size], align_corners=False)
        # In the grid's precision: 8 bits of mantissa would be a wrong place by a tenth of a pixel.
        return sample(images.flatten(1, 2).float(), grid).to(images.dtype).unflatten(1, (n_frames, 3))


def sample(images: Tensor, grid: Tensor) -> Tensor:
    """Bilinear samples, with the outermost pixels repeated outwards.

    That is `grid_sample`'s padding "border", which Apple's GPUs have not before torch 2.13: the coordinates end at the
    centres of the outermost pixels.

    Args:
        images: (B, C, H, W).
        grid: (B, size, size, 2), x and y from -1 to 1.

    Returns:
        (B, C, size, size).
    """
    height, width = images.shape[-2:]
    limits = (1 - 1 / width, 1 - 1 / height)
    inside = torch.stack([grid[..., axis].clamp(-limit, limit) for axis, limit in enumerate(limits)], dim=-1)
    return functional.grid_sample(images, inside, mode="bilinear", padding_mode="zeros", align_corners=False)


def resize(images: Tensor, size: int) -> Tensor:
    """(B, T, 3, H, W) -> (B, T, 3, size, size), bilinear, averaging where it shrinks."""
    if images.shape[-2:] == (size, size):
        return images
    flat, shrinks = images.flatten(0, 1), max(images.shape[-2:]) > size
    flat = functional.interpolate(flat, (size, size), mode="bilinear", align_corners=False, antialias=shrinks)
    return flat.unflatten(0, images.shape[:2])


def _uniform(n: int, device: torch.device) -> Tensor:
    return torch.empty(n, device=device).uniform_(-1, 1)
