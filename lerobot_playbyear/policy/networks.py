"""The network of the policy, from top to bottom (paper, appendix "Architecture Details").

In comments: B items, n frames of each, K windows of H frames, D numbers that the memory reads of a frame, W channels of the
first stage. What makes it fast on a CPU is attached from outside (`cpu_inference.py`).
"""

import math

import torch
from lerobot.utils.constants import OBS_PREFIX
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import ResNet

from lerobot_playbyear.compat import BasicBlock
from lerobot_playbyear.policy.auxiliary import AuxiliaryHeads, weights_of
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig, segment_and_hop
from lerobot_playbyear.policy.extension import make_encoder, register_audio_encoder, register_vision_encoder
from lerobot_playbyear.policy.image_augmentation import Augmentation, resize
from lerobot_playbyear.policy.optimization import HAS_512_BITS
from lerobot_playbyear.policy.sound_augmentation import SoundAugmentation
from lerobot_playbyear.policy.spectrogram import EPSILON, LogSpectrogram, SharedStretches, to_float_wave

_IMAGE_MEAN, _IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_AUDIO_KERNEL = 7
_ENCODING_SIZE = 0.5  # root mean square of a normalised encoding
_NEARER = 1.0  # [10 dB] by which the arm's own sound is louder than at the reference microphone, each above its mean
_SHARPNESS = 4.0  # a choice among frames is learned in as few updates as the rest


class PlaybyearNetwork(nn.Module):
    """Vision, hearing, fusion, memory and head, from batches of runs of frames."""

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        self.config = config
        assert config.action_feature is not None
        self.augment = Augmentation(config)
        sizes: list[int] = []  # of what is fused, in the order in which `encode` lists it
        if config.use_vision:
            encoders = {_module_name(key): make_encoder("vision_encoder", config) for key in config.camera_keys}
            self.vision = nn.ModuleDict(encoders)
            sizes += [encoder.embedding_size for encoder in self.vision.values()]  # type: ignore[misc]
        if config.use_audio:
            assert config.sample_rate is not None
            grid = (config.sample_rate, config.segment_s, config.hop_s, config.n_frequency_bins)
            self.spectrogram = nn.ModuleDict()
            self.hearing = nn.ModuleDict()
            for key in config.heard_keys:
                self.hearing[_module_name(key)] = make_encoder("audio_encoder", config)
            hears_waveform = any(getattr(encoder, "hears_waveform", False) for encoder in self.hearing.values())
            if hears_waveform and config.reference_key:
                raise ValueError(
                    f"--policy.audio_encoder={config.audio_encoder} hears the waveform, and "
                    "--policy.reference_microphone takes noise out of spectrograms: leave one of the two out."
                )
            if not hears_waveform or config.audio_envelope_gain:
                for key in config.audio_keys:
                    self.spectrogram[_module_name(key)] = LogSpectrogram(*grid, config.spectrogram_momentum)
            self.disturb = SoundAugmentation(config)
            n_columns = config.n_segments if config.audio_envelope_gain else 0
            sizes += [encoder.embedding_size + n_columns for encoder in self.hearing.values()]  # type: ignore[misc, operator]
        felt = [math.prod(config.feature_shape(key)) for key in config.low_dimensional_keys]
        self.fusion = Fusion(sum([*sizes, *felt]), config)
        self.memory_head = MemoryHead(config, config.action_feature.shape[0], sum(felt))
        # Last, so that all else begins with the weights that it has without.
        self.auxiliary = AuxiliaryHeads(config) if any(weights_of(config).values()) else None

    def encode_run(self, batch: dict[str, Tensor], n_frames: int) -> Tensor:
        """Joint encodings of the last `n_frames` frames of every item, each encoded once: (B, n_frames, D).

        Where the episode had not begun, the first frame's encoding repeats.
        """
        encodings = self.encode(batch, n_frames).unflatten(0, (-1, n_frames))  # (B, n, D)
        is_pad = before_episode(batch, n_frames)  # (B, n)
        if is_pad is None:
            return encodings
        before = is_pad.sum(dim=1).clamp(max=n_frames - 1)  # (B,)
        index = torch.maximum(torch.arange(n_frames, device=encodings.device), before.unsqueeze(1))  # (B, n)
        return encodings.gather(1, index.unsqueeze(-1).expand(-1, -1, encodings.shape[-1]))  # (B, n, D)

    def encode(self, batch: dict[str, Tensor], n_frames: int) -> Tensor:
        """What the memory reads of every frame by itself, (B * n, D): the joint encoding, and what it compares with now."""
        config = self.config
        seen = [self._see(batch, key, n_frames) for key in config.camera_keys if config.use_vision]
        heard = self._hear_all(batch, n_frames) if config.use_audio else []
        felt = [self._feel(batch, key, n_frames) for key in config.low_dimensional_keys]
        return self.memory_head.with_felt(self.fusion([*seen, *heard, *felt]), felt)

    def _see(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """One camera's embeddings, (B * n, embedding size)."""
        n_stacked = self.config.frame_stack
        images = newest(batch, key, n_frames + n_stacked - 1)  # (B, n + n_stacked - 1, 3, H, W)
        images = self.prepare_images(images, self.config.feature_shape(key)[-2:])  # (..., 3, size, size)
        # (B, n, 3 n_stacked, size, size)
        stacks = torch.cat([images[:, i : i + n_frames] for i in range(n_stacked)], dim=2)
        return self._normalize(self.vision[_module_name(key)](stacks.flatten(0, 1)))

    def _hear_all(self, batch: dict[str, Tensor], n_frames: int) -> list[Tensor]:
        """Embeddings of every microphone but the reference, (B * n, embedding size); in training all are in the same room."""
        config = self.config
        assert config.sample_rate is not None
        n_heard, keys = n_frames + config.audio_frames - 1, config.audio_keys
        sounds = [newest(batch, key, n_heard, config.feature_shape(key)) for key in keys]  # (B, n_heard, S) each
        waves = [to_float_wave(sound.flatten(1), key) for sound, key in zip(sounds, keys, strict=True)]
        colours: list[Tensor | None] = [None] * len(keys)
        if self.training:
            noisy, colour = self.disturb(torch.stack(waves, dim=1))  # (B, microphones, n_heard * S)
            waves, colours = list(noisy.unbind(1)), colours if colour is None else list(colour.unbind(1))
        n_samples = sounds[0].shape[2]
        begun = torch.ones_like(waves[0], dtype=torch.bool)  # (B, n_heard * S)
        is_pad = before_episode(batch, n_heard)  # (B, n_heard)
        if is_pad is not None:
            begun = ~is_pad.repeat_interleave(n_samples, dim=1)
        _, hop = segment_and_hop(config.sample_rate, config.segment_s, config.hop_s)
        # Neighbouring windows overlap: their segments are computed once.
        shared = SharedStretches(n_frames, n_samples, config.window_samples, hop)
        levels: dict[str, Tensor] = {}  # (B * n_stretches, bins, columns) each
        for key, wave, colour in zip(keys, waves, colours, strict=True):
            if _module_name(key) in self.spectrogram:
                if colour is not None:  # (B, bins)
                    colour = colour.repeat_interleave(shared.n_stretches, dim=0)
                spectrogram = self.spectrogram[_module_name(key)]
                levels[key] = spectrogram(shared.stretches(wave), shared.stretches(begun), colour)
        if config.reference_key is not None:
            levels = self._masked(levels, config.reference_key)
        heard = dict(zip(keys, waves, strict=True))
        return [self._hear(key, shared, heard[key], begun, levels.get(key)) for key in config.heard_keys]

    def _masked(self, levels: dict[str, Tensor], reference: str) -> dict[str, Tensor]:
        """Spectrograms, with the average wherever the reference microphone hears as much, each above its own mean."""
        variance = {key: self.spectrogram[_module_name(key)].get_buffer("variance") for key in levels}
        above = {key: level * (variance[key] + EPSILON).sqrt()[:, None] for key, level in levels.items()}  # [10 dB]
        return {key: level * (above[key] > above[reference] + _NEARER) for key, level in levels.items()}

    def _hear(self, key: str, shared: SharedStretches, wave: Tensor, begun: Tensor, levels: Tensor | None) -> Tensor:
        """One microphone's embeddings, (B * n, embedding size), and with `audio_envelope_gain` also its columns' means.

        Args:
            key: The microphone's.
            shared: The windows' stretches.
            wave: What it heard, (B, n_heard * S).
            begun: Whether the episode had begun, the same shape.
            levels: Its spectrogram, (B * n_stretches, bins, columns).
        """
        config, encoder = self.config, self.hearing[_module_name(key)]
        n_columns = getattr(encoder, "window_columns", None)
        if getattr(encoder, "hears_waveform", False):
            start = wave.shape[1] - shared.length - (shared.n_windows - 1) * shared.step
            windows = (wave * begun)[:, start:].unfold(1, shared.length, shared.step)  # (B, n, samples)
            embeddings = encoder(windows.flatten(0, 1))
        elif isinstance(n_columns, int):  # convolutional along time: embeddings overlap, too
            assert levels is not None
            embeddings = shared.windows(encoder(levels), n_columns)  # (B * n, channels, n_columns)
        else:
            assert levels is not None
            embeddings = encoder(shared.windows(levels, config.n_segments))
        heard = self._normalize(embeddings.flatten(1))
        if config.audio_envelope_gain == 0 or levels is None:
            return heard
        envelope = shared.windows(levels.mean(dim=1, keepdim=True), config.n_segments).flatten(1)  # (B * n, n_segments)
        return torch.cat([heard, config.audio_envelope_gain * envelope], dim=1)

    def _feel(self, batch: dict[str, Tensor], key: str, n_frames: int) -> Tensor:
        """One low-dimensional observation, (B * n, its numbers)."""
        values = newest(batch, key, n_frames, self.config.feature_shape(key))  # (B, n, ...)
        values = values.flatten(2).float()  # (B, n, its numbers)
        if self.training and self.config.low_dimensional_noise > 0:
            values = values + self.config.low_dimensional_noise * torch.randn_like(values)
        if self.training and self.config.low_dimensional_offset > 0:
            values = values + self.config.low_dimensional_offset * torch.randn_like(values[:, :1])
        return self.config.low_dimensional_gain * values.flatten(0, 1)  # (B * n, its numbers)

    def prepare_images(self, images: Tensor, recorded: tuple[int, ...] | None = None) -> Tensor:
        """(B, T, 3, H, W) bytes or in [0, 1] -> (B, T, 3, size, size) in [0, 1], in training augmented.

        `recorded` is the height and width of the camera's pictures, where they may have been shrunk since [pixels].
        """
        size = self.config.image_size
        with torch.autocast(images.device.type, enabled=False):  # colours keep their 8 bits
            images = images.float().div_(255) if images.dtype == torch.uint8 else images
            return self.augment(images, size, recorded) if self.training else resize(images, size)

    def _normalize(self, embeddings: Tensor) -> Tensor:
        """(N, E) -> (N, E), of the same size whatever the sense."""
        if not self.config.normalize_encodings:
            return embeddings
        return _ENCODING_SIZE * functional.layer_norm(embeddings, embeddings.shape[1:])


class VisionEncoder(nn.Module):
    """ResNet-18 from scratch over channel-wise stacked images, up to the layer before the last.

    Args:
        n_stacked: Images per stack.
        width: Channels of the first stage; 64 is ResNet-18. The embedding has 8 times as many.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, n_stacked: int, width: int):
        super().__init__()
        self.embedding_size = 8 * width
        self.network = SlimResNet(3 * n_stacked, width)
        self.register_buffer("mean", torch.tensor(_IMAGE_MEAN).repeat(n_stacked)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_IMAGE_STD).repeat(n_stacked)[:, None, None], persistent=False)

    def forward(self, stacks: Tensor) -> Tensor:
        """(N, 3 * n_stacked, size, size) in [0, 1] -> (N, embedding_size)."""
        return self.network(self.normalize(stacks))

    def normalize(self, stacks: Tensor) -> Tensor:
        """(N, 3 * n_stacked, size, size) in [0, 1] -> the same shape, as networks for images want it."""
        return (stacks - self.mean) / self.std


class SlimResNet(ResNet):
    """torchvision's ResNet-18 with another number of input channels and another width, without the classifier."""

    def __init__(self, in_channels: int, width: int):
        # What follows takes the place of its layers; forward is torchvision's.
        super().__init__(BasicBlock, [2, 2, 2, 2])
        self.conv1 = nn.Conv2d(in_channels, width, kernel_size=7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)  # (N, W, size / 2, size / 2); then ReLU, and pooling by 2
        self.layer1 = _stage(width, width)  # (N, W, size / 4, size / 4)
        self.layer2 = _stage(width, 2 * width, stride=2)  # (N, 2 W, size / 8, size / 8)
        self.layer3 = _stage(2 * width, 4 * width, stride=2)  # (N, 4 W, size / 16, size / 16)
        self.layer4 = _stage(4 * width, 8 * width, stride=2)  # (N, 8 W, size / 32, size / 32); then the mean, (N, 8 W)
        self.fc = nn.Identity()
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")


def _stage(n_in: int, n_out: int, stride: int = 1) -> nn.Sequential:
    """Two residual blocks: (N, n_in, h, w) -> (N, n_out, h / stride, w / stride)."""
    shortcut = None
    if n_in != n_out:
        shortcut = nn.Sequential(nn.Conv2d(n_in, n_out, 1, stride, bias=False), nn.BatchNorm2d(n_out))
    return nn.Sequential(BasicBlock(n_in, n_out, stride, shortcut), BasicBlock(n_out, n_out))


class AudioEncoder(nn.Module):
    """Convolutions over time, frequency bins as channels.

    Args:
        n_bins: Frequency bins.
        n_segments: Columns of the spectrogram.
        channels: Output channels of each convolution.

    Attributes:
        window_columns: Columns that are left of a window's segments.
    """

    def __init__(self, n_bins: int, n_segments: int, channels: tuple[int, ...]):
        super().__init__()
        self.window_columns = n_segments - len(channels) * (_AUDIO_KERNEL - 1)
        if self.window_columns < 1:
            raise ValueError(
                f"audio_window_s holds {n_segments} segments, too few for {len(channels)} convolutions of kernel "
                f"{_AUDIO_KERNEL}: at least {1 + len(channels) * (_AUDIO_KERNEL - 1)} are needed."
            )
        layers: list[nn.Module] = []
        for n_in, n_out in zip((n_bins, *channels), channels, strict=False):
            layers += [nn.Conv1d(n_in, n_out, _AUDIO_KERNEL), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.embedding_size = channels[-1] * self.window_columns

    def forward(self, spectrogram: Tensor) -> Tensor:
        """(N, n_bins, n_segments + extra) -> (N, channels[-1], window_columns + extra), embeddings before they are flattened.

        Extra segments belong to later windows of the same sound; their embeddings are slices of the result.
        """
        return self.layers(spectrogram)


@register_vision_encoder("resnet18")
def _vision_encoder(config: PlaybyearConfig) -> VisionEncoder:
    return VisionEncoder(config.frame_stack, config.vision_width)


@register_audio_encoder("spectrogram_cnn")
def _audio_encoder(config: PlaybyearConfig) -> AudioEncoder:
    return AudioEncoder(config.n_frequency_bins, config.n_segments, tuple(config.audio_channels))


class Fusion(nn.Module):
    """MLP from all encodings of a frame, cameras', microphones' and low-dimensional observations', to one joint encoding z."""

    def __init__(self, size: int, config: PlaybyearConfig):
        super().__init__()
        self.layers = mlp(size, config.hidden_size, config.embedding_size)

    def forward(self, encodings: list[Tensor]) -> Tensor:
        """[(N, ...)], `size` numbers together -> (N, embedding size)."""
        return self.layers(torch.cat(encodings, dim=-1))


class MemoryHead(nn.Module):
    """One-layer LSTM over a window of frames, fresh for every window, and an MLP from its last output.

    Of every frame it reads the joint encoding (the paper) and, with `memory_displacement_gain`, how far what the arm measured
    then is from what it measures now. Without that the LSTM has to find a way of centimetres as the difference of two places
    that it knows in units of the whole workspace.

    In comments: B items, K windows of H frames, D numbers of a frame: the joint encoding and the displacement.

    Args:
        config: The policy's configuration.
        n_actions: Numbers of an action.
        n_felt: Of all low-dimensional observations of a frame together.
    """

    def __init__(self, config: PlaybyearConfig, n_actions: int, n_felt: int):
        super().__init__()
        self.memory_steps, self.action_range = config.memory_steps, config.action_range
        self.displacement_gain = config.memory_displacement_gain / (config.low_dimensional_gain or 1.0)
        self.n_fused = config.embedding_size
        n_compared = n_felt if self.displacement_gain else 0
        self.lstm = nn.LSTM(self.n_fused + n_compared, config.embedding_size, batch_first=True)
        self.head = mlp(config.embedding_size, config.hidden_size, n_actions)
        self.recollection = None
        if config.memory_readers and n_compared:
            self.recollection = Recollection(config.memory_readers, self.n_fused, n_compared, self.memory_steps)

    def with_felt(self, fused: Tensor, felt: list[Tensor]) -> Tensor:
        """What is kept of frames: their joint encodings (N, embedding size), and with displacements what was felt, (N, D)."""
        return torch.cat([fused, *felt], dim=-1) if self.displacement_gain else fused

    def forward(self, encodings: Tensor) -> Tensor:
        """The action after every full window of consecutive frames, (B, n, D).

        Returns:
            (B, K, n_actions) with K = n - H + 1, in [-1, 1] times the action range.
        """
        return self.act(self.recall(encodings))

    def recall(self, encodings: Tensor) -> Tensor:
        """(B, n, D) consecutive frames -> (B, K, embedding size), the memory's output after every full window."""
        windows = encodings.unfold(1, self.memory_steps, 1).transpose(2, 3)  # (B, K, H, D)
        if self.displacement_gain:
            felt = windows[..., self.n_fused :]
            displacement = self.displacement_gain * (felt - felt[:, :, -1:])
            windows = torch.cat([windows[..., : self.n_fused], displacement], dim=-1)
        outputs = self._remember(windows.flatten(0, 1))  # (B * K, H, embedding size)
        remembered = outputs[:, -1].unflatten(0, windows.shape[:2])
        if self.recollection is None:
            return remembered
        return remembered + self.recollection(encodings[..., : self.n_fused], windows[..., self.n_fused :])

    def _remember(self, windows: Tensor) -> Tensor:
        """(N, H, D) -> (N, H, embedding size). Not in bfloat16 where oneDNN has no LSTM in it: on CPUs without AVX-512."""
        if windows.device.type == "cpu" and not HAS_512_BITS:
            with torch.autocast("cpu", enabled=False):
                return self.lstm(windows.to(next(self.lstm.parameters()).dtype))[0]
        return self.lstm(windows)[0]

    def act(self, memories: Tensor) -> Tensor:
        """(..., embedding size) of `recall` -> (..., n_actions)."""
        actions = self.head(memories.flatten(0, -2)).float()  # whatever autocast computed in
        actions = self.action_range * torch.tanh(actions / self.action_range)
        return actions.unflatten(0, memories.shape[:-1])


class Recollection(nn.Module):
    """Reads, of the frames that it chooses by what was seen and heard in them, how far the arm was from where it is now.

    An LSTM has to carry such a length through all later frames, and hops of six centimetres end millimetres beside the cube.
    Here each of M readers gives every frame of the window a weight (a softmax over frames, of its
    joint encoding and of how long ago it was), and the mean of the displacements is added to what the LSTM remembers.

    Args:
        n_readers: M.
        n_fused: Of a joint encoding.
        n_compared: Of a displacement.
        n_steps: Frames in a window, H.
    """

    def __init__(self, n_readers: int, n_fused: int, n_compared: int, n_steps: int):
        super().__init__()
        self.score = nn.Linear(n_fused, n_readers)
        self.recency = nn.Parameter(torch.zeros(n_readers, n_steps))
        self.read = nn.Linear(n_readers * n_compared, n_fused, bias=False)
        # Displacements are tens of units: other weights drive the actions' tanh to its ends.
        nn.init.zeros_(self.read.weight)

    def forward(self, fused: Tensor, displacement: Tensor) -> Tensor:
        """Joint encodings (B, n, D) and every window's displacements (B, K, H, numbers) -> (B, K, D)."""
        scores = _SHARPNESS * self.score(fused).unfold(1, displacement.shape[2], 1)  # (B, K, M, H)
        weights = (scores + self.recency).softmax(dim=-1)
        return self.read((weights @ displacement).flatten(2))


def mlp(n_in: int, hidden: int, n_out: int) -> nn.Sequential:
    """Two hidden layers: (N, n_in) -> (N, n_out)."""
    layers = (nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, n_out))
    return nn.Sequential(*layers)


def newest(batch: dict[str, Tensor], key: str, n_frames: int, shape: tuple[int, ...] | None = None) -> Tensor:
    """The last `n_frames` frames of a key, (B, n_frames, ...), each of the given shape."""
    if key not in batch:
        raise ValueError(f"The batch has no '{key}', which the policy was built for; it has {sorted(batch)}.")
    values = batch[key]
    if values.dim() < 2 or values.shape[1] < n_frames:
        raise ValueError(f"'{key}' has shape {tuple(values.shape)}, but its second dimension needs {n_frames} frames.")
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


def _module_name(key: str) -> str:
    return key.removeprefix(OBS_PREFIX).replace(".", "_")
