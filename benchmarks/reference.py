"""The published scheme, written plainly: what our training and acting are compared with; and our policy on the same noise.

Du et al., "Play it by Ear" (RSS 2022): every training window of ten frames is encoded again, all ten frames of it, to
supervise one action; so is the window behind every control step. The sizes are the paper's, and its augmentation is a
shift, a change of colours and an affine map, one after the other, on every frame's stack. Memory layout, memory
allocation and precision are PyTorch's defaults. Weights of a `PlaybyearPolicy` fit (`load_from`).
"""

import itertools
import random
from collections.abc import Mapping

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models import resnet18
from torchvision.transforms import v2
from torchvision.transforms.v2 import functional as image_functional

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

MEMORY_STEPS, FRAME_STACK, IMAGE_SIZE = 10, 3, 224
SAMPLE_RATE, FPS, SECONDS = 16000, 20, 2
_SEGMENT, _HOP, _BINS = 640, 560, 160  # 40 ms, 35 ms, up to 4 kHz
_IMAGE_MEAN, _IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Reference(nn.Module):
    """Windows in, one action per window out."""

    window: Tensor
    level_mean: Tensor
    level_std: Tensor
    image_mean: Tensor
    image_std: Tensor

    def __init__(self, n_state: int = 7, n_actions: int = 4, augments: bool = True) -> None:
        super().__init__()
        self.augments = augments
        self.vision = resnet18()
        self.vision.conv1 = nn.Conv2d(3 * FRAME_STACK, 64, 7, stride=2, padding=3, bias=False)
        self.vision.fc = nn.Identity()
        channels = (_BINS, 64, 32, 16, 8)
        pairs = [(nn.Conv1d(a, b, 7), nn.ReLU()) for a, b in itertools.pairwise(channels)]
        self.hearing = nn.Sequential(*itertools.chain.from_iterable(pairs))
        self.fusion = _mlp(512 + 264 + n_state, 50)
        self.lstm = nn.LSTM(50, 50, batch_first=True)
        self.head = _mlp(50, n_actions)
        self.register_buffer("window", torch.hann_window(_SEGMENT), persistent=False)
        self.register_buffer("level_mean", torch.zeros(_BINS))
        self.register_buffer("level_std", torch.ones(_BINS))
        self.register_buffer("image_mean", torch.tensor(_IMAGE_MEAN * FRAME_STACK)[:, None, None], persistent=False)
        self.register_buffer("image_std", torch.tensor(_IMAGE_STD * FRAME_STACK)[:, None, None], persistent=False)

    def forward(self, images: Tensor, sound: Tensor, state: Tensor) -> Tensor:
        """Actions of windows.

        Args:
            images: (B, 12, 3, H, W) in [0, 1]: ten frames, and the two before the first.
            sound: (B, samples) in [-1, 1]: what the ten frames' last two seconds span.
            state: (B, 10, n_state).

        Returns:
            (B, n_actions).
        """
        n = len(images)
        stacks = torch.stack([images[:, t : t + FRAME_STACK] for t in range(MEMORY_STEPS)], dim=1)
        stacks = stacks.flatten(0, 1)  # (B * 10, 3, 3, H, W)
        if self.training and self.augments:
            stacks = torch.stack([augment(stack) for stack in stacks])
        stacks = functional.interpolate(stacks.flatten(1, 2), (IMAGE_SIZE, IMAGE_SIZE), mode="bilinear")
        seen = self.vision((stacks - self.image_mean) / self.image_std)  # (B * 10, 512)
        heard_by_frame = sound.unfold(1, SECONDS * SAMPLE_RATE, SAMPLE_RATE // FPS)  # (B, 10, samples of 2 s)
        heard = self.hearing(self.spectrogram(heard_by_frame.flatten(0, 1))).flatten(1)  # (B * 10, 264)
        encodings = self.fusion(torch.cat([seen, heard, state.flatten(0, 1)], dim=1))
        outputs, _ = self.lstm(encodings.view(n, MEMORY_STEPS, -1))
        return torch.tanh(self.head(outputs[:, -1]))

    def spectrogram(self, wave: Tensor) -> Tensor:
        """(N, samples) -> (N, bins, segments), normalised log power."""
        spectrum = torch.stft(
            wave, _SEGMENT, _HOP, window=self.window, center=False, return_complex=True
        )  # (N, all bins, segments)
        power = spectrum[:, :_BINS].abs().square() * 4 / self.window.sum().square()
        return (torch.log10(power + 1e-10) - self.level_mean[:, None]) / self.level_std[:, None]

    def load_from(
        self, weights: Mapping[str, Tensor], camera: str = "images_front", mic: str = "audio_gripper"
    ) -> None:
        """Takes the weights of a policy of the paper's sizes: `policy.model.state_dict()`."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}

        self.vision.load_state_dict(part(f"vision.{camera}.network."))
        self.hearing.load_state_dict(part(f"hearing.{mic}.layers."))
        self.fusion.load_state_dict(part("fusion.layers."))
        self.lstm.load_state_dict(part("memory_head.lstm."))
        self.head.load_state_dict(part("memory_head.head."))
        self.level_mean.copy_(weights[f"spectrogram.{mic}.mean"])
        self.level_std.copy_((weights[f"spectrogram.{mic}.variance"] + 1e-5).sqrt())


def augment(stack: Tensor) -> Tensor:
    """The paper's augmentation of one frame's stack of images, (3, 3, H, W) in [0, 1]."""
    height, width = stack.shape[-2:]
    padded = functional.pad(stack, (4, 4, 4, 4), mode="replicate")
    top, left = random.randint(0, 8), random.randint(0, 8)
    stack = padded[..., top : top + height, left : left + width]
    stack = image_functional.adjust_brightness(stack, 1 + random.uniform(-0.05, 0.05))
    stack = image_functional.adjust_hue(stack, random.uniform(-0.05, 0.05))
    shift = [random.uniform(-0.05, 0.05) * width, random.uniform(-0.05, 0.05) * height]
    turned, scale = random.uniform(-5, 5), 1 + random.uniform(-0.05, 0.05)
    return image_functional.affine(stack, turned, shift, scale, [0.0, 0.0], interpolation=v2.InterpolationMode.BILINEAR)


def random_windows(n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Noise in place of n windows: images, sound, state and the action."""
    samples = SECONDS * SAMPLE_RATE + (MEMORY_STEPS - 1) * SAMPLE_RATE // FPS
    images = torch.rand(n, MEMORY_STEPS + FRAME_STACK - 1, 3, 84, 84)
    sound, state = 0.02 * torch.randn(n, samples), torch.randn(n, MEMORY_STEPS, 7)
    return images, sound, state, torch.rand(n, 4) * 2 - 1


def _mlp(n_in: int, n_out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_in, 1024), nn.ReLU(), nn.Linear(1024, 1024), nn.ReLU(), nn.Linear(1024, n_out))


# Our policy

CAMERA, MICROPHONE, STATE = "observation.images.front", "observation.audio.gripper", "observation.state"
SAMPLES, PIXELS = 800, 84  # of a frame: 16 kHz at 20 Hz, and the simulation's pictures


def make_policy(n_microphones: int = 1, sample_rate: int = 16000, fps: int = 20, **options) -> PlaybyearPolicy:
    """A new policy on the simulation's observations, of the paper's sizes where the options do not say otherwise."""
    sound = PolicyFeature(FeatureType.STATE, (sample_rate // fps,))
    inputs = {
        CAMERA: PolicyFeature(FeatureType.VISUAL, (3, PIXELS, PIXELS)),
        **{MICROPHONE + str(i or ""): sound for i in range(n_microphones)},
        STATE: PolicyFeature(FeatureType.STATE, (7,)),
    }
    features = {"input_features": inputs, "output_features": {"action": PolicyFeature(FeatureType.ACTION, (4,))}}
    rates = {"sample_rate": sample_rate, "fps": fps}
    return PlaybyearPolicy(PlaybyearConfig(**features, **rates, device="cpu", push_to_hub=False, **options))


def bare_resnet(n_frames: int, image_size: int) -> tuple[nn.Module, Tensor]:
    """The vision encoder's ResNet alone, and frames that are already as it reads them."""
    policy = make_policy(use_audio=False)
    encoder = policy.model.vision[CAMERA.removeprefix("observation.").replace(".", "_")]
    frames = torch.rand(n_frames, 9, image_size, image_size).contiguous(memory_format=torch.channels_last)
    return encoder.network, frames


def random_runs(config: PlaybyearConfig, n: int) -> dict[str, Tensor]:
    """A training batch of n runs of noise, as `EpisodeStore` gives it: bytes and 16-bit sound."""
    batch = {STATE: torch.randn(n, config.n_run_frames, 7)}
    for key in config.camera_keys:
        batch[key] = torch.randint(0, 256, (n, config.n_image_frames, 3, PIXELS, PIXELS), dtype=torch.uint8)
    for key in config.audio_keys:
        batch[key] = (500 * torch.randn(n, config.n_audio_frames, *config.feature_shape(key))).to(torch.int16)
    batch["action"] = torch.rand(n, config.n_supervised_steps, 4) * 2 - 1
    return batch


def random_observations(n: int) -> list[dict[str, Tensor]]:
    """Observations of n control steps, noise, as LeRobot hands them to `select_action`."""
    return [
        {CAMERA: torch.rand(1, 3, PIXELS, PIXELS), MICROPHONE: 0.02 * torch.randn(1, SAMPLES), STATE: torch.randn(1, 7)}
        for _ in range(n)
    ]
