"""Supervised windows per second in training at 224 pixels, beside the published scheme and the bare ResNet.

    python benchmarks/training.py

A whole update counts: augmentation, spectrograms, network, gradients, clipping and Adam. The published scheme
(`benchmarks/reference.py`) runs in a process of its own, with PyTorch's own memory allocation, in turn with ours. The limit
is the time that the ResNet's forward and backward pass alone take for the frames that an update encodes. Noise as data.
"""

import argparse
import os
import statistics
import sys
from collections.abc import Callable

import torch
from common import Helper, Row, in_turns, medians, parser_for, run, seconds_of, serve
from reference import Reference, random_windows
from torch import nn

REFERENCE_WINDOWS = 4  # per update; its cost per window does not depend on it
RUNS = {8: 2, 16: 2, 32: 2}  # windows per run, K, and runs per update
WANTED_AT_DEFAULT, WANTED_AT_32 = 10, 20  # times the published scheme
OVERHEAD_WANTED = 1.3


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


def our_update(n_supervised_steps: int, image_size: int, amp: bool = False) -> Callable[[], None]:
    """An update of the policy of the paper's sizes."""
    from policies import make_policy, random_runs

    policy = make_policy(image_size=image_size, n_supervised_steps=n_supervised_steps).train()
    batch = random_runs(policy.config, RUNS[n_supervised_steps])

    def loss() -> torch.Tensor:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=amp):
            return policy(batch)[0]

    return update_of(policy, loss)


def bare_passes(n_frames: int, image_size: int) -> Callable[[], None]:
    """Forward and backward pass of the vision encoder's ResNet alone."""
    from policies import bare_resnet

    network, frames = bare_resnet(n_frames, image_size)
    network.train()

    def passes() -> None:
        network(frames).square().mean().backward()
        network.zero_grad()

    return passes


def measure(args: argparse.Namespace) -> list[Row]:
    code = "from training import serve_reference; serve_reference()"
    helper = Helper(sys.executable, "-c", code, PYTHONPATH=os.pathsep.join(sys.path))
    from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
    from lerobot_playbyear.training.heap import keep_freed_memory

    keep_freed_memory()  # as playbyear-train does
    config = PlaybyearConfig(device="cpu")
    default = config.n_supervised_steps
    wanted_times = {default: WANTED_AT_DEFAULT, 32: WANTED_AT_32}
    variants = [(k, False) for k in RUNS] + [
        (k, True) for k in wanted_times
    ]  # windows per run, and whether in bfloat16
    works: dict[object, Callable[[], object]] = {(k, amp): our_update(k, args.image_size, amp) for k, amp in variants}
    for k in wanted_times:
        works["bare", k] = bare_passes(RUNS[k] * (k + config.n_memory_steps - 1), args.image_size)
    theirs: list[float] = []
    works["reference"] = lambda: theirs.append(helper.measure())
    seconds = medians(in_turns(works, args.turns))
    helper.close()

    reference, rows = REFERENCE_WINDOWS / statistics.median(theirs[1:]), []
    for k, amp in variants:
        note = ", bfloat16 (`--policy.use_amp=true`)" if amp else " (default)" if k == default else ""
        windows, wanted = RUNS[k] * k, wanted_times.get(k)
        ours = windows / seconds[k, amp]
        bare = windows / seconds["bare", k] if wanted and not amp else None
        rows.append(
            Row(
                f"training, {args.image_size} px, K = {k}{note}",
                ours,
                "windows/s",
                "ten frames per window (K = 1), float32",
                reference,
                "convolutions alone" if bare else "",
                bare,
                f"at least {wanted} times" if wanted else "",
                ours >= wanted * reference if wanted else None,
            )
        )
    overhead = seconds[default, False] / seconds["bare", default]
    rows.append(
        Row(
            "a whole update over its convolutions' time",
            overhead,
            "times",
            limit_is="convolutions alone",
            limit=1.0,
            wanted=f"at most {OVERHEAD_WANTED}",
            holds=overhead <= OVERHEAD_WANTED,
        )
    )
    return rows


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=4)
    parser.add_argument("--image_size", type=int, default=224)
    run("training", parser, measure)
