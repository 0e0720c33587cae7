"""What acting remembers of an episode: as much of the past as one frame's encoding reaches back."""

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor

from lerobot_playbyear.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.runs import newest


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
