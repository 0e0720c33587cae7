"""Supervised windows per second in training at 224 pixels, beside the published scheme and the bare ResNet; and hearing.

    python benchmarks/training.py

A whole update counts: augmentation, spectrograms, network, gradients, clipping and Adam. The published scheme
(`benchmarks/reference.py`) runs in a process of its own, with PyTorch's own memory allocation, in turn with ours. The limit
is the time that the ResNet's forward and backward pass alone take for the frames that an update encodes. Then, on one thread,
what hearing costs an update of the preset `cpu`: neighbouring windows share the columns of the spectrogram in which they
coincide, with 25 ms between them all, with the paper's 35 ms those of every seventh frame. And what rooms and a reference
microphone cost it.
Noise as data.
"""

import argparse
import json
import os
import statistics
import sys
from collections.abc import Callable

import torch
from common import Helper, Row, in_turns, medians, parser_for, run, seconds_of, serve
from reference import Reference, bare_resnet, make_policy, random_runs, random_windows
from torch import nn

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.optimization import computes_bfloat16
from lerobot_playbyear.training.command_line import RECIPES
from lerobot_playbyear.training.learner import keep_freed_memory

REFERENCE_WINDOWS = 4  # per update; its cost per window does not depend on it
RUNS = 2  # per update
EARS = {
    "25 ms": {"hop_s": 0.025},
    "35 ms": {"hop_s": 0.035},
    "deaf": {"use_audio": False},
    "in rooms": {"audio_room_noise": True},
    "with a reference": {"audio_room_noise": True, "n_microphones": 2, "reference_microphone": "gripper1"},
}


def update_of(module: nn.Module, loss: Callable[[], torch.Tensor]) -> Callable[[], None]:
    """An update as LeRobot does it: forward, backward, clip, Adam."""
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-4)

    def update() -> None:
        loss().backward()
        nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()

    return update


def serve_reference() -> None:
    """The published scheme, in a process of its own: seconds of an update."""
    model = Reference().train()
    images, sound, state, action = random_windows(REFERENCE_WINDOWS)
    update = update_of(model, lambda: (model(images, sound, state) - action).square().mean())
    update()
    serve(lambda _: seconds_of(update))


def our_update(n_runs: int, amp: bool = False, **options) -> Callable[[], None]:
    """An update of the policy of the paper's sizes."""
    policy = make_policy(**options).train()
    batch = random_runs(policy.config, n_runs)

    def loss() -> torch.Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=amp):
            return policy(batch)[0]

    return update_of(policy, loss)


def bare_passes(n_frames: int, image_size: int) -> Callable[[], None]:
    """Forward and backward pass of the vision encoder's ResNet alone."""
    network, frames = bare_resnet(n_frames, image_size)
    network.train()

    def passes() -> None:
        network(frames).square().mean().backward()
        network.zero_grad()

    return passes


def training(turns: int, size: int) -> list[Row]:
    code = "from training import serve_reference; serve_reference()"
    helper, theirs = Helper(sys.executable, "-c", code, PYTHONPATH=os.pathsep.join(sys.path)), []
    keep_freed_memory()  # as playbyear-train does
    variants = [(k, amp) for amp in (False, True) for k in (8, 16, 32)]
    works: dict[object, Callable[[], object]] = {
        (k, amp): our_update(RUNS, amp, image_size=size, n_supervised_steps=k) for k, amp in variants
    }
    memory_steps = PlaybyearConfig(device="cpu").n_memory_steps
    works |= {("bare", k): bare_passes(RUNS * (k + memory_steps - 1), size) for k in (8, 16, 32)}
    works["reference"] = lambda: (helper.ask(), theirs.append(helper.answer()))
    seconds = medians(in_turns(works, turns))
    helper.close()
    beside = ("ten frames per window (K = 1), float32", REFERENCE_WINDOWS / statistics.median(theirs[1:]))
    rows = []
    for k, amp in variants:
        limit = () if amp else ("convolutions alone", RUNS * k / seconds["bare", k])
        name = f"training, {size} px, K = {k}" + ", bfloat16 (`--policy.use_amp=true`)" * amp
        rows.append(Row(name, RUNS * k / seconds[k, amp], "windows/s", *beside, *limit))
    return rows


def hearing(turns: int) -> list[Row]:
    recipe = json.loads((RECIPES / "cpu.json").read_text())
    preset = {name: value for name, value in recipe["policy"].items() if name not in ("type", "device", "push_to_hub")}
    torch.set_num_threads(1)
    updates = {
        ear: our_update(recipe["batch_size"], computes_bfloat16(), **{**preset, **options})
        for ear, options in EARS.items()
    }
    ms = {ear: 1000 * value for ear, value in medians(in_turns(updates, turns)).items()}
    beside = ("every 35 ms", ms["35 ms"], "deaf", ms["deaf"])
    name = "an update of the preset `cpu`, one thread, columns every 25 ms"
    return [
        Row(name, ms["25 ms"], "ms", *beside),
        Row(f"{name}, in rooms", ms["in rooms"], "ms", "without", ms["25 ms"]),
        Row(f"{name}, in rooms, with a reference microphone", ms["with a reference"], "ms", "without", ms["in rooms"]),
    ]


def measure(args: argparse.Namespace) -> list[Row]:
    return training(args.turns, args.image_size) + hearing(args.turns)


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--image_size", type=int, default=224)
    run(parser, measure)
