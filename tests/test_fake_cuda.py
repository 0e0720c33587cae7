"""Training on an NVIDIA GPU, as far as it can be seen without one: everything lies on the card, and the host never waits.

A fake tensor has a device, a shape and no numbers. Tensors of two devices do not mix; whatever asks for a number makes a
real host wait for its card. nn.LSTM itself asks the driver for cuDNN; without cuDNN it is torch's own.
"""

import traceback
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from test_policy_contract import make_config, make_episode, run_ending_at
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

import lerobot_playbyear
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy, RecentFrames

PACKAGE = Path(lerobot_playbyear.__file__).parent


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


@pytest.fixture
def policy():
    return PlaybyearPolicy(make_config(audio_noise_db=0.0, low_dimensional_noise=0.03, n_supervised_steps=3))


def test_a_training_forward_stays_on_the_card_and_the_host_never_waits(policy):
    real = run_ending_at(make_episode(1, policy.config), 5, policy.config)
    with FakeTensorMode():
        move_to_card(policy)
        batch = {key: on_card(value) for key, value in real.items()}
        policy.train()
        with Waits() as waits, without_cudnn():
            loss, _ = policy.forward(batch)
        assert loss.device.type == "cuda"
        assert waits.lines == []


def test_acting_stays_on_the_card_and_the_host_waits_once_per_microphone(policy):
    """For whether its samples are between -1 and 1; the action is waited for anyway. Fake weights cannot be folded."""
    policy.eval()
    with FakeTensorMode():
        move_to_card(policy)
        recent = RecentFrames(policy.config)
        features = policy.config.input_features.items()
        with Waits() as waits, without_cudnn():
            for _ in range(3):
                frame = {key: torch.rand(1, *feature.shape, device="cuda") for key, feature in features}
                encoding = policy.model.encode_frame(recent.add(frame, policy.model.prepare_images))
                actions = policy.model.memory_head(encoding.unsqueeze(1).repeat(1, policy.config.memory_steps, 1))
        assert actions.device.type == "cuda"
        assert len(waits.lines) == 3
        assert all("peak" in line for line in waits.lines)


def test_a_tensor_left_on_the_host_is_noticed(policy):
    """What the other tests rest on."""
    real = run_ending_at(make_episode(1, policy.config), 30, policy.config)
    with FakeTensorMode():
        move_to_card(policy)
        batch = {key: on_card(value) for key, value in real.items()}
        batch["observation.state"] = torch.empty(batch["observation.state"].shape)
        with pytest.raises(RuntimeError, match="device"):
            policy.model.encode_run(batch, policy.config.n_run_frames)
