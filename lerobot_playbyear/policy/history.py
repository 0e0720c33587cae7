"""Which frames a window sees: cut out of runs in training, remembered from step to step while acting."""

from collections import deque
from collections.abc import Callable

import torch
from lerobot.utils.constants import OBS_PREFIX
from torch import Tensor

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig


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


def before_episode(batch: dict[str, Tensor], n_frames: int) -> Tensor | None:
    """Which of the last `n_frames` frames lie before the episode, (B, n_frames), or None when nothing says so.

    All keys end at the same frame, so any key's flags do; a renamed key has lost its own.
    """
    flags = [batch[name] for name in batch if name.startswith(OBS_PREFIX) and name.endswith("_is_pad")]
    return next((is_pad[:, -n_frames:] for is_pad in flags if is_pad.shape[1] >= n_frames), None)


class RecentFrames:
    """The last images of every camera and the last seconds of every microphone, of B episodes that began together."""

    def __init__(self, config: PlaybyearConfig) -> None:
        self._config = config
        self._images: dict[str, deque[Tensor]] = {}
        self._sound: dict[str, Tensor] = {}
        self._n_heard = 0

    def add(self, frame: dict[str, Tensor], prepare_images: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """Takes the newest frame.

        Args:
            frame: Images (B, 3, H, W), sound (B, S), the rest (B, n).
            prepare_images: Makes of images, (B, 1, 3, H, W), what the encoder looks at. Called once per image.

        Returns:
            What one encoding needs, as a batch of runs of one frame.
        """
        config = self._config
        run: dict[str, Tensor] = {}
        for key in config.camera_keys if config.use_vision else ():
            image = prepare_images(frame[key].unsqueeze(1)).squeeze(1)  # (B, 3, size, size)
            buffer = self._images.setdefault(key, deque([image] * config.frame_stack, maxlen=config.frame_stack))
            buffer.append(image)
            run[key] = torch.stack(list(buffer), dim=1)  # (B, frame_stack, 3, size, size)
        if config.use_audio:
            self._n_heard = min(self._n_heard + 1, config.audio_frames)
        for key in config.audio_keys if config.use_audio else ():
            sound = newest({key: frame[key].unsqueeze(1)}, key, 1, config.feature_shape(key)).squeeze(1)  # (B, S)
            earlier = self._sound.get(key)
            if earlier is None:
                earlier = sound.new_zeros(sound.shape[0], sound.shape[1] * config.audio_frames)
            self._sound[key] = torch.cat([earlier[:, sound.shape[1] :], sound], dim=1)
            run[key] = self._sound[key].unflatten(1, (config.audio_frames, -1))
            is_pad = torch.arange(config.audio_frames, device=sound.device) < config.audio_frames - self._n_heard
            run[f"{key}_is_pad"] = is_pad.expand(sound.shape[0], -1)
        for key in config.low_dimensional_keys:
            run[key] = frame[key].unsqueeze(1)
        return run
