"""Cutting the newest frames out of a batch of runs, and telling which of them lie before the episode."""

from lerobot.utils.constants import OBS_PREFIX
from torch import Tensor


def newest(batch: dict[str, Tensor], key: str, n_frames: int, shape: tuple[int, ...] | None = None) -> Tensor:
    """The last `n_frames` frames of a key, (B, n_frames, ...), each of the given shape."""
    if key not in batch:
        raise ValueError(f"The batch has no '{key}', which the policy was built for; it has {sorted(batch)}.")
    values = batch[key]
    if values.dim() < 2 or values.shape[1] < n_frames:
        raise ValueError(
            f"'{key}' has shape {tuple(values.shape)}, but {n_frames} frames are needed along its second dimension."
        )
    values = values[:, -n_frames:]
    if shape == (1,) and values.dim() == 2:  # LeRobot reads a column of single numbers as scalars
        values = values.unsqueeze(-1)
    if shape is not None and values.shape[2:] != shape:
        raise ValueError(
            f"'{key}' has shape {tuple(values.shape[2:])} per frame, but the policy was made for {tuple(shape)}: use "
            "the sensor, the sample rate and the frame rate that it was trained with."
        )
    return values


def before_episode(batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor | None:
    """Which of the last `n_frames` frames lie before the episode, (B, n_frames), or None when nothing says so.

    All keys end at the same frame, so another key's flags do where a renamed key has lost its own.
    """
    flags = [batch[f"{key}_is_pad"]] if f"{key}_is_pad" in batch else []
    flags += [batch[name] for name in batch if name.startswith(OBS_PREFIX) and name.endswith("_is_pad")]
    return next((is_pad[:, -n_frames:] for is_pad in flags if is_pad.shape[1] >= n_frames), None)
