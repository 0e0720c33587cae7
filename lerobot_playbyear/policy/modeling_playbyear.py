"""The policy `playbyear`: what LeRobot calls, and how observations become the network's inputs."""

import math
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from lerobot.utils.device_utils import resolve_safetensors_device
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.policy.augmentation import Augmentation, resize
from lerobot_playbyear.policy.card import with_hearing, write_card
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.history import RecentFrames, before_episode, newest
from lerobot_playbyear.policy.networks import AudioEncoder, Fusion, MemoryHead, VisionEncoder
from lerobot_playbyear.policy.shared_statistics import mean_over_processes
from lerobot_playbyear.policy.spectrogram import (
    LogSpectrogram,
    SharedStretches,
    mix_in_noise,
    segment_and_hop,
    to_float_wave,
)

_ENCODING_SIZE = 0.5  # root mean square of a normalised encoding


class PlaybyearPolicy(PreTrainedPolicy):
    """Audio-visual LSTM policy of "Play it by Ear" (Du et al., RSS 2022).

    Training and rollout use one definition: z_i = fuse(vision(images i-2..i), sound(the 2 s up to i), state_i) and
    a_t = head(LSTM(z_{t-9..t})). Before the episode's first frame its image and its z repeat, and the spectrogram is the
    average sound.
    """

    config_class = PlaybyearConfig
    name = "playbyear"

    def __init__(self, config: PlaybyearConfig, dataset_stats: dict[str, Any] | None = None, **kwargs: Any):
        if not isinstance(config, PlaybyearConfig):
            raise ValueError(
                f"This is a checkpoint of the policy type '{config.type}', wanted '{self.name}': give the folder "
                "`pretrained_model` of a playbyear policy."
            )
        super().__init__(config)
        _check_fps(config)
        config.validate_features()
        self.config: PlaybyearConfig = config
        self.model = PlaybyearNetwork(config)
        self.reset()

    def get_optim_params(self) -> Any:
        return self.parameters()

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Writes a checkpoint, of copies: on a GPU an LSTM's weights are views of one buffer, which safetensors refuses."""
        if state_dict is None:
            as_saved = {"device": "cpu", "copy": True, "memory_format": torch.contiguous_format}
            state_dict = {name: value.to(**as_saved) for name, value in self.state_dict().items()}
        super()._save_pretrained(save_directory, state_dict=state_dict)

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        """Loads a checkpoint. LeRobot's own leaves weights that it lacks at random; here that is an error."""
        hint = "Use the configuration, with the sizes and the inputs, that the checkpoint was trained with."
        try:
            weights = load_file(model_file, device=resolve_safetensors_device(map_location))
            missing, unexpected = model.load_state_dict(weights, strict=False)
        except RuntimeError as error:
            raise ValueError(f"{model_file} does not fit the policy. {hint}\n{error}") from error
        if missing or (strict and unexpected):
            raise ValueError(
                f"{model_file} does not fit the policy: it lacks {sorted(missing)[:3]} and has {sorted(unexpected)[:3]} "
                f"too many, of {len(missing)} and {len(unexpected)}. {hint}"
            )
        return model

    def generate_model_card(self, *args: Any, **kwargs: Any) -> Any:
        """LeRobot's card, with what the policy hears."""
        return with_hearing(write_card(super().generate_model_card, self.config, *args, **kwargs), self.config)

    def keep_normalization(self) -> None:
        """From now on sound is normalised by the statistics that the spectrograms have, in training too."""
        for module in self.modules():
            if isinstance(module, LogSpectrogram):
                module.keeps_statistics = True

    def reset(self) -> None:
        """Forgets the episode."""
        self.model.prepare_to_act()
        self._recent = RecentFrames(self.config)
        self._encodings: Tensor | None = None

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Mean squared error over the K windows of every item that end inside its episode.

        Args:
            batch: `<key>` (B, T, ...) and `<key>_is_pad` (B, T) with the newest frame last. T may differ between keys and
                be longer than needed: images need `n_image_frames`, sound `n_audio_frames`, the rest `n_run_frames`,
                the action the last K. Windows whose `action_is_pad` is true are not learned from.
            reduction: "mean" for one loss, "none" for one of every item, (B,), as LeRobot's sample weights want it.

        Returns:
            The loss, and numbers for the log.

        Raises:
            ValueError: A key is missing or sound is not finite.
        """
        predicted = self.predict_run(batch)  # (B, K, n_actions)
        n_windows = predicted.shape[1]
        target = newest(batch, ACTION, n_windows, predicted.shape[-1:])
        error = (predicted - target).square().mean(dim=-1)  # (B, K)
        weight = torch.ones_like(error)
        if f"{ACTION}_is_pad" in batch:
            weight = weight * ~batch[f"{ACTION}_is_pad"][:, -n_windows:]
        if reduction == "none":
            losses = (error * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-8)  # (B,)
            return losses, {"mse": losses.mean().item()}
        # Over the mean weight of all processes: the mean of their losses is then that of one with all their items.
        total = mean_over_processes(weight.sum()) if self.training else weight.sum()
        loss = (error * weight).sum() / total.clamp(min=1e-8)
        return loss, {"mse": loss.item()}

    def predict_run(self, batch: dict[str, Tensor], n_steps: int | None = None) -> Tensor:
        """Actions of the last `n_steps` (default K) frames of every item, (B, n_steps, n_actions), normalised."""
        n_frames = (n_steps or self.config.n_supervised_steps) + self.config.memory_steps - 1
        encodings = self.model.encode_run(batch, n_frames)  # (B, R, D)
        return self.model.memory_head(encodings)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action for the newest observation; only this frame is encoded.

        Args:
            batch: One frame of a batch of B episodes that began together: images (B, 3, H, W), sound (B, S), the rest (B, n).

        Returns:
            (B, n_actions), normalised.
        """
        if self.training:
            self.eval()
        run = self._recent.add(batch, self.model.prepare_images)
        device = next(iter(run.values())).device
        with torch.autocast(device.type, enabled=False):  # bfloat16 would round positions to half a millimetre
            encoding = self.model.encode_frame(run)  # (B, D)
            if self._encodings is None:
                self._encodings = encoding.unsqueeze(1).repeat(1, self.config.memory_steps, 1)
            else:
                self._encodings = torch.cat([self._encodings[:, 1:], encoding.unsqueeze(1)], dim=1)
            return self.model.memory_head(self._encodings)[:, -1]

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action of `select_action` as a chunk of one, (B, 1, n_actions)."""
        return self.select_action(batch).unsqueeze(1)


class PlaybyearNetwork(nn.Module):
    """All parameters of the policy, from observations to joint encodings, and from those to actions."""

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        assert config.action_feature is not None
        self.config = config
        features = config.input_features or {}
        self.augment = Augmentation(
            config.augmentation_crop,
            config.augmentation_brightness,
            config.augmentation_hue,
            config.augmentation_degrees,
            config.augmentation_translate,
            config.augmentation_scale,
        )
        cameras = config.camera_keys
        microphones = config.audio_keys
        n_fused = sum(math.prod(features[key].shape) for key in config.low_dimensional_keys)
        if config.use_vision:
            self.vision = nn.ModuleDict(
                {_module_name(key): VisionEncoder(config.frame_stack, config.vision_width) for key in cameras}
            )
            n_fused += len(cameras) * 8 * config.vision_width
        if config.use_audio:
            assert config.sample_rate is not None
            spectrogram = (config.sample_rate, config.segment_s, config.hop_s, config.n_frequency_bins)
            self.spectrogram = nn.ModuleDict(
                {_module_name(key): LogSpectrogram(*spectrogram, config.spectrogram_momentum) for key in microphones}
            )
            self.hearing = nn.ModuleDict({_module_name(key): self._audio_encoder() for key in microphones})
            n_fused += sum(encoder.embedding_size for encoder in self.hearing.values())  # type: ignore[misc]
        self.fusion = Fusion(n_fused, config)
        self.memory_head = MemoryHead(config, config.action_feature.shape[0])

    def encode_run(self, batch: dict[str, Tensor], n_frames: int) -> Tensor:
        """Joint encodings of the last `n_frames` frames of every item, each encoded once: (B, n_frames, D).

        Where the episode had not begun, the first frame's encoding repeats.
        """
        parts = [
            *(self._see(batch, key, n_frames) for key in self.config.camera_keys if self.config.use_vision),
            *(self._hear(batch, key, n_frames) for key in self.config.audio_keys if self.config.use_audio),
            *(self._feel(batch, key, n_frames) for key in self.config.low_dimensional_keys),
        ]
        n_items = len(next(iter(batch[key] for key in batch if isinstance(batch[key], Tensor))))
        encodings = self.fusion(parts).unflatten(0, (n_items, n_frames))
        is_pad = before_episode(batch, self._padded_key(), n_frames)
        if is_pad is None:
            return encodings
        before = is_pad.sum(dim=1).clamp(max=n_frames - 1)  # (B,)
        index = torch.maximum(torch.arange(n_frames, device=encodings.device), before.unsqueeze(1))  # (B, R)
        return encodings.gather(1, index.unsqueeze(-1).expand(-1, -1, encodings.shape[-1]))

    def encode_frame(self, run: dict[str, Tensor]) -> Tensor:
        """Joint encoding of the newest frame: (B, D)."""
        parts = [
            *(self._see(run, key, 1) for key in self.config.camera_keys if self.config.use_vision),
            *(self._hear(run, key, 1) for key in self.config.audio_keys if self.config.use_audio),
            *(self._feel(run, key, 1) for key in self.config.low_dimensional_keys),
        ]
        return self.fusion(parts)

    def _feel(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """One low-dimensional observation, (B * n_frames, n)."""
        values = newest(batch, key, n_frames, self.config.feature_shape(key))
        values = values.flatten(0, 1).flatten(1).float()
        if self.training and self.config.low_dimensional_noise > 0:
            values = values + self.config.low_dimensional_noise * torch.randn_like(values)
        return self.config.low_dimensional_gain * values

    def _see(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """One camera's embeddings, (B * n_frames, embedding size)."""
        config = self.config
        images = self.prepare_images(newest(batch, key, n_frames + config.frame_stack - 1))  # (B, T, 3, size, size)
        stacks = torch.cat([images[:, i : i + n_frames] for i in range(config.frame_stack)], dim=2)
        return self._normalize(self.vision[_module_name(key)](stacks.flatten(0, 1)))

    def _hear(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """One microphone's embeddings, (B * n_frames, embedding size)."""
        config = self.config
        n_heard = n_frames + config.audio_frames - 1
        sound = newest(batch, key, n_heard, config.feature_shape(key))  # (B, T, S)
        wave = to_float_wave(sound.flatten(1), key)
        if self.training and config.audio_noise_db is not None:
            assert config.sample_rate is not None
            wave = mix_in_noise(wave, config.audio_noise_db, config.sample_rate)
        begun = torch.ones_like(wave, dtype=torch.bool)
        is_pad = before_episode(batch, key, n_heard)
        if is_pad is not None:
            begun = ~is_pad.repeat_interleave(sound.shape[2], dim=1)
        spectrogram, encoder = self.spectrogram[_module_name(key)], self.hearing[_module_name(key)]
        assert isinstance(spectrogram, LogSpectrogram)
        assert isinstance(encoder, AudioEncoder)
        shared = SharedStretches(n_frames, sound.shape[2], config.window_samples, spectrogram.hop)
        levels = spectrogram(shared.stretches(wave), shared.stretches(begun))
        return self._normalize(shared.windows(encoder(levels), encoder.length).flatten(1))

    def prepare_images(self, images: Tensor) -> Tensor:
        """(B, T, 3, H, W) bytes or in [0, 1] -> (B, T, 3, size, size) in [0, 1], in training augmented."""
        size = self.config.image_size
        with torch.autocast(images.device.type, enabled=False):  # colours keep their 8 bits
            images = images.float() / 255 if images.dtype == torch.uint8 else images
            return self.augment(images, size) if self.training else resize(images, size)

    def prepare_to_act(self) -> None:
        """Makes ready what acting needs and learning does not."""
        for encoder in self.vision.values() if self.config.use_vision else ():
            encoder.refresh()  # type: ignore[operator]

    def _normalize(self, encodings: Tensor) -> Tensor:
        if not self.config.normalize_encodings:
            return encodings
        return _ENCODING_SIZE * functional.layer_norm(encodings, encodings.shape[1:])

    def _padded_key(self) -> str:
        """An observation that every batch has."""
        config = self.config
        keys = [*config.low_dimensional_keys, *(config.camera_keys if config.use_vision else []), *config.audio_keys]
        return keys[0]

    def _audio_encoder(self) -> AudioEncoder:
        config = self.config
        assert config.sample_rate is not None
        segment, hop = segment_and_hop(config.sample_rate, config.segment_s, config.hop_s)
        n_segments = (config.window_samples - segment) // hop + 1
        return AudioEncoder(config.n_frequency_bins, n_segments, tuple(config.audio_channels))


def _module_name(key: str) -> str:
    return key.removeprefix("observation.").replace(".", "_")


def _check_fps(config: PlaybyearConfig) -> None:
    meta = getattr(config, "_runtime_dataset_meta", None)
    if meta is not None and meta.fps != config.fps:
        raise ValueError(
            f"The dataset has fps={meta.fps}, but the policy is configured for fps={config.fps}: set --policy.fps={meta.fps}, "
            "or train a new policy for this dataset."
        )
