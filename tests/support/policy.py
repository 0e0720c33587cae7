"""Small policies, episodes of noise for them, and a graphics card that is not there."""

import traceback
from contextlib import contextmanager
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

import lerobot_playbyear
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

MICROPHONE, CAMERA, STATE = "observation.audio.gripper", "observation.images.front", "observation.state"
N_STEPS, SAMPLES = 55, 800  # of an episode, and of a frame
PACKAGE = Path(lerobot_playbyear.__file__).parent


def make_config(cameras=("front",), microphones=("gripper",), **options) -> PlaybyearConfig:
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (7,))}
    inputs |= {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 40, 40)) for name in cameras}
    inputs |= {f"observation.audio.{name}": PolicyFeature(FeatureType.STATE, (SAMPLES,)) for name in microphones}
    defaults = {"image_size": 32, "vision_width": 4, "hidden_size": 32, "sample_rate": 16000, "device": "cpu"}
    return PlaybyearConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (4,))},
        push_to_hub=False,
        **(defaults | options),
    )


def make_policy(**options) -> PlaybyearPolicy:
    """A policy whose running statistics have seen something."""
    torch.manual_seed(0)
    policy = PlaybyearPolicy(make_config(**options))
    policy.train()
    policy.forward(run_ending_at(make_episode(seed=9, config=policy.config), 30, policy.config))
    return policy.eval()


def make_episode(seed: int, config: PlaybyearConfig, n_frames: int = N_STEPS) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    episode = {"action": torch.rand(n_frames, 4, generator=generator) * 2 - 1}
    for key, feature in config.input_features.items():
        if key in config.audio_keys:
            episode[key] = torch.randint(-3000, 3000, (n_frames, *feature.shape), generator=generator).to(torch.int16)
        else:
            episode[key] = torch.rand(n_frames, *feature.shape, generator=generator)
    return episode


def window(episode, key: str, last: int, n_frames: int):
    """Frames up to `last` as LeRobot pads them: (1, n_frames, ...) and the flags (1, n_frames)."""
    wanted = torch.arange(last - n_frames + 1, last + 1)
    return episode[key][wanted.clamp(min=0)].unsqueeze(0), (wanted < 0).unsqueeze(0)


def run_ending_at(episode, last: int, config: PlaybyearConfig, n_steps: int | None = None):
    n_frames = (n_steps or config.n_supervised_steps) + config.audio_frames + config.memory_steps
    batch = {}
    for key in config.input_features:
        batch[key], batch[f"{key}_is_pad"] = window(episode, key, last, n_frames)
    steps = n_steps or config.n_supervised_steps
    batch["action"], batch["action_is_pad"] = window(episode, "action", last, steps)
    return batch


def step_through(policy, episodes):
    policy.reset()
    actions = []
    for t in range(len(episodes[0]["action"])):
        observation = {key: torch.stack([e[key][t] for e in episodes]) for key in policy.config.input_features}
        actions.append(policy.select_action(observation))
    return torch.stack(actions, dim=1)  # (n_episodes, T, 4)


def batch_of(policy, lasts=(30, 45), seed=1):
    """Runs of an episode that end at these frames."""
    episode = make_episode(seed, policy.config)
    runs = [run_ending_at(episode, last, policy.config) for last in lasts]
    return {key: torch.cat([run[key] for run in runs]) for key in runs[0]}


# A fake tensor has a device, a shape and no numbers. Tensors of two devices do not mix; whatever asks for a number makes a real
# host wait for its card. nn.LSTM itself asks the driver for cuDNN; without cuDNN it is torch's own.


class Waits(TorchDispatchMode):
    """Notes the lines of the package at which the host waits for the card: numbers asked for, and copies from and to it."""

    def __init__(self, numbers=0.5):
        super().__init__()
        self.numbers, self.lines = numbers, []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function is torch.ops.aten._local_scalar_dense.default and args[0].device.type == "cuda":
            self._note()
            return self.numbers
        before = [arg.device for arg in args if isinstance(arg, Tensor) and arg.dim() > 0]
        result = function(*args, **(kwargs or {}))
        if isinstance(result, Tensor) and any(device != result.device for device in before):
            self._note()
        return result

    def _note(self):
        frames = [frame for frame in traceback.extract_stack() if PACKAGE in Path(frame.filename).parents]
        self.lines.append(f"{Path(frames[-1].filename).name}: {frames[-1].line}" if frames else "elsewhere")


def on_card(value):
    return torch.empty(value.shape, dtype=value.dtype, device="cuda")


def move_to_card(policy):
    """As `.to("cuda")`, which would ask for the driver."""
    for module in policy.modules():
        for name, value in module._parameters.items():
            module._parameters[name] = None if value is None else nn.Parameter(on_card(value))
        for name, value in module._buffers.items():
            module._buffers[name] = None if value is None else on_card(value)
        if isinstance(module, nn.RNNBase):
            module._flat_weights = [getattr(module, name) for name in module._flat_weights_names]


@contextmanager
def without_cudnn():
    enabled = torch._C._get_cudnn_enabled()
    torch._C._set_cudnn_enabled(False)
    yield
    torch._C._set_cudnn_enabled(enabled)
