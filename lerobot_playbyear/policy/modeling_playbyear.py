"""The policy `playbyear`: what LeRobot calls. What it computes is in `networks.py`."""

import logging
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION
from lerobot.utils.device_utils import resolve_safetensors_device
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_playbyear.compat import card_writer
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy.batch_norm import is_first_process, mean_over_processes, share_batch_norm
from lerobot_playbyear.policy.card import with_hearing, write_card
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.cpu_inference import act_by_folded_copies, prepare_to_act
from lerobot_playbyear.policy.networks import PlaybyearNetwork, newest
from lerobot_playbyear.policy.spectrogram import LogSpectrogram, to_float_wave

logger = logging.getLogger(__name__)


class PlaybyearPolicy(PreTrainedPolicy):
    """Audio-visual LSTM policy of "Play it by Ear" (Du et al., RSS 2022).

    Training and rollout use one definition: z_i = fuse(vision(images i-2..i), sound(the 2 s up to i), state_i) and
    a_t = head(LSTM(z_{t-9..t})). Before the episode's first frame its image and its z repeat, and the spectrogram is the
    average sound.
    """

    config_class = PlaybyearConfig
    name = "playbyear"

    def __init__(self, config: PlaybyearConfig, dataset_meta: Any = None, **kwargs: Any):
        if not isinstance(config, PlaybyearConfig):
            raise ValueError(
                f"This is a checkpoint of the policy type '{config.type}', wanted '{self.name}': give the folder "
                "`pretrained_model` of a playbyear policy."
            )
        super().__init__(config)
        if dataset_meta is not None:
            config.check_dataset(dataset_meta)
        config.validate_features()
        self.config: PlaybyearConfig = config
        self.model = PlaybyearNetwork(config)
        share_batch_norm(self.model)
        act_by_folded_copies(self.model)
        self.reset()

    def get_optim_params(self) -> Any:
        return self.model.parameters()

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Writes a checkpoint, of copies: on a GPU an LSTM's weights are views of one buffer, which LeRobot's own refuses.

        Args:
            save_directory: Where to.
            state_dict: The weights, where LeRobot 0.6.1 has gathered them; None: the policy's. Later versions call this in
                every process of a training, and the first writes.
        """
        if not is_first_process():
            return
        as_saved: dict[str, Any] = {"device": "cpu", "copy": True, "memory_format": torch.contiguous_format}
        weights = self.state_dict() if state_dict is None else state_dict
        copies = {name: value.to(**as_saved) for name, value in weights.items()}
        self.config.save_pretrained(save_directory)
        save_file(copies, save_directory / SAFETENSORS_SINGLE_FILE, metadata={"format": "pt"})

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        """Loads a checkpoint. LeRobot's own leaves weights that it lacks at random; here that is an error.

        Raises:
            InputError: The file cannot be read, does not fit, or holds what is not finite.
        """
        hint = "Use the configuration, with the sizes and the inputs, that the checkpoint was trained with."
        try:
            weights = load_file(model_file, device=resolve_safetensors_device(map_location))
        except (SafetensorError, OSError) as error:
            raise InputError(f"{model_file} is missing or damaged: {error}. Give another checkpoint.") from error
        endless = sorted(name for name, value in weights.items() if not value.isfinite().all())
        if endless:
            raise InputError(
                f"{model_file} holds infinite numbers or NaN, in {endless[:3]}, of {len(endless)}. Its training diverged: "
                "give an earlier checkpoint."
            )
        try:
            missing, unexpected = model.load_state_dict(weights, strict=False)
        except RuntimeError as error:
            raise InputError(f"{model_file} does not fit the policy. {hint}\n{error}") from error
        told = (
            f"it lacks {sorted(missing)[:3]} and has {sorted(unexpected)[:3]} too many, of {len(missing)} and "
            f"{len(unexpected)}. {hint}"
        )
        if missing or (strict and unexpected):
            raise InputError(f"{model_file} does not fit the policy: {told}")
        if unexpected:
            logger.warning("%s does not fit the policy exactly: %s The surplus is left out.", model_file, told)
        return model

    def generate_model_card(self, *args: Any, **kwargs: Any) -> Any:
        """LeRobot's card, with what the policy hears."""
        writer = card_writer(super(), self.config)
        return with_hearing(write_card(writer, self.config, *args, **kwargs), self.config)

    def keep_normalization(self) -> None:
        """From now on sound is normalised by the statistics that the spectrograms have, in training too."""
        for module in self.modules():
            if isinstance(module, LogSpectrogram):
                module.keeps_statistics = True

    def reset(self) -> None:
        """Forgets the episode; `memory`, (B, D), is what the policy remembers since the last `select_action`."""
        prepare_to_act(self.model)
        self._recent = RecentFrames(self.config)
        self._encodings: Tensor | None = None
        self.memory: Tensor | None = None

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error over the K windows of every item that end inside its episode.

        Args:
            batch: `<key>` (B, T, ...) and `<key>_is_pad` (B, T) with the newest frame last. T may differ between keys and
                be longer than needed: images need `n_image_frames`, sound `n_audio_frames`, the rest `n_run_frames`,
                the action the last K. Windows whose `action_is_pad` is true are not learned from.
            reduction: "mean" for one loss, "none" for one of every item, (B,), as LeRobot's sample weights want it.

        Returns:
            The loss, and for the log, where training has `auxiliary_*` losses, its parts. Out of training the loss is that of
            the action alone.

        Raises:
            ValueError: A key is missing or sound is not finite.
        """
        network, config = self.model, self.config
        encodings = network.encode_run(batch, config.n_run_frames)  # (B, R, D)
        outputs = network.memory_head.recall(encodings)  # (B, K, D)
        predicted = network.memory_head.act(outputs)  # (B, K, n_actions)
        n_windows = predicted.shape[1]
        target = newest(batch, ACTION, n_windows, predicted.shape[-1:])
        error = (predicted - target).square().mean(dim=-1)  # (B, K)
        weight = torch.ones_like(error)
        if f"{ACTION}_is_pad" in batch:
            weight = weight * ~batch[f"{ACTION}_is_pad"][:, -n_windows:]
        loss = self._average(error, weight, reduction)
        if network.auxiliary is None or not self.training:
            return loss, {}
        figures = {"loss_action": loss.detach().mean()}
        waves = [to_float_wave(self._newest(batch, key, config.n_audio_frames), key) for key in config.heard_keys]
        felt = [self._newest(batch, key, config.n_run_frames).flatten(2) for key in config.low_dimensional_keys]
        fused = encodings[:, -n_windows:, : config.embedding_size]
        for kind, (error, counts) in network.auxiliary(waves, felt, fused, outputs).items():
            average = self._average(error, weight * counts, reduction)
            figures[f"loss_{kind}"] = average.detach().mean()
            loss = loss + network.auxiliary.weights[kind] * average
        return loss, figures

    def _newest(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        return newest(batch, key, n_frames, self.config.feature_shape(key))

    def _average(self, error: Tensor, weight: Tensor, reduction: str) -> Tensor:
        """Of errors (B, n) with weights: one number, or with "none" one of every item, (B,)."""
        if reduction == "none":
            return (error * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-8)
        # Over the mean weight of all processes: the mean of their losses is then that of one with all their items.
        total = mean_over_processes(weight.sum()) if self.training else weight.sum()
        return (error * weight).sum() / total.clamp(min=1e-8)

    def memory_run(self, batch: dict[str, Tensor], n_steps: int | None = None) -> Tensor:
        """What the policy remembers at the last `n_steps` (default K) frames of every item, (B, n_steps, D)."""
        n_frames = (n_steps or self.config.n_supervised_steps) + self.config.memory_steps - 1
        return self.model.memory_head.recall(self.model.encode_run(batch, n_frames))

    def act_from(self, memories: Tensor) -> Tensor:
        """The actions (..., n_actions), normalised, that follow from memories (..., D)."""
        return self.model.memory_head.act(memories)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action for the newest observation; only this frame is encoded.

        Args:
            batch: One frame of a batch of B episodes that began together: images (B, 3, H, W), sound (B, S), the rest (B, n).

        Returns:
            (B, n_actions), normalised.

        Raises:
            ValueError: There is no sound in the observation.
        """
        missing = [key for key in self.config.audio_keys if key not in batch] if self.config.use_audio else []
        if missing:
            raise ValueError(
                f"This policy hears, and there is no sound in the observation: {', '.join(missing)} is missing. "
                "On a robot lerobot-rollout hears by --robot.cameras='{mic: {type: microphone, device: ...}}'. "
                "lerobot.async_inference registers no packages, and carries no sound."
            )
        if self.training:
            self.eval()
        network = self.model
        run = self._recent.add(batch, network.prepare_images)
        device = next(iter(run.values())).device
        with torch.autocast(device.type, enabled=False):  # bfloat16 would round positions to half a millimetre
            encoding = network.encode(run, 1)  # (B, D)
            if self._encodings is None:
                self._encodings = encoding.unsqueeze(1).repeat(1, self.config.memory_steps, 1)
            else:
                self._encodings = torch.cat([self._encodings[:, 1:], encoding.unsqueeze(1)], dim=1)
            self.memory = network.memory_head.recall(self._encodings)[:, -1]  # (B, D)
            return self.act_from(self.memory)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The action of `select_action` as a chunk of one, (B, 1, n_actions)."""
        return self.select_action(batch).unsqueeze(1)


class RecentFrames:
    """The last images of every camera and the last seconds of every microphone, of B episodes that began together."""

    def __init__(self, config: PlaybyearConfig) -> None:
        self._config = config
        self._frames: dict[str, deque[Tensor]] = {}
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
        run = {key: frame[key].unsqueeze(1) for key in config.low_dimensional_keys}
        for key in config.camera_keys if config.use_vision else ():
            image = prepare_images(frame[key].unsqueeze(1)).squeeze(1)  # (B, 3, size, size)
            run[key] = self._latest(key, image, image, config.frame_stack)
        self._n_heard = min(self._n_heard + 1, config.audio_frames)
        for key in config.audio_keys if config.use_audio else ():
            sound = newest({key: frame[key].unsqueeze(1)}, key, 1, config.feature_shape(key)).squeeze(1)  # (B, S)
            run[key] = self._latest(key, sound.clone(), torch.zeros_like(sound), config.audio_frames)
            is_pad = torch.arange(config.audio_frames, device=sound.device) < config.audio_frames - self._n_heard
            run[f"{key}_is_pad"] = is_pad.expand(sound.shape[0], -1)
        return run

    def _latest(self, key: str, frame: Tensor, before: Tensor, n: int) -> Tensor:
        """The last n frames of a key, (B, n, ...), up to this one; `before` stands for those before the episode."""
        frames = self._frames.setdefault(key, deque([before] * n, maxlen=n))
        frames.append(frame)
        return torch.stack(list(frames), dim=1)
