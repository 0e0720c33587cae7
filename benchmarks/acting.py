"""Latency of a control step, median and 99th percentile, beside encoding the whole window again.

    python benchmarks/acting.py

One episode, one step after the other, policies of the paper's width: what `select_action` takes. Beside it, the published
scheme, which encodes the ten frames of its window at every step; the limit is the ResNet's forward pass for one frame.
"""

import argparse
import itertools
from collections.abc import Callable

import numpy as np
import torch
from common import Row, in_turns, medians, parser_for, run
from reference import Reference, bare_resnet, make_policy, random_observations, random_windows


def stepper(image_size: int) -> Callable[[], object]:
    """A control step of an episode."""
    policy = make_policy(image_size=image_size).eval()
    policy.reset()
    observations = itertools.cycle(random_observations(32))
    return torch.inference_mode()(lambda: policy.select_action(next(observations)))  # as lerobot-eval does


def re_encoder() -> Callable[[], object]:
    """A control step of the published scheme."""
    model = Reference().eval()
    images, sound, state, _ = random_windows(1)
    return torch.inference_mode()(lambda: model(images, sound, state))


def forward_pass(image_size: int) -> Callable[[], object]:
    """The plain ResNet's forward pass for one frame, its weights laid out beforehand."""
    network, frame = bare_resnet(1, image_size)
    network.eval().to(memory_format=torch.channels_last)
    return torch.inference_mode()(lambda: network(frame))


def measure(args: argparse.Namespace) -> list[Row]:
    rows = []
    for size in (224, 84):
        works = {"ours": stepper(size), "bare": forward_pass(size)}
        seconds = in_turns(works, args.turns, warm_up=20)
        middle = medians(seconds)
        beside = {}
        if size == 224:  # the paper's
            theirs = medians(in_turns({"theirs": re_encoder(), **works}, max(5, args.turns // 30)))["theirs"]
            beside = {"beside": "encoding the window again", "theirs": 1e3 * theirs}
        limit = {"limit_is": "the ResNet alone", "limit": 1e3 * middle["bare"]}
        tail = float(np.percentile(seconds["ours"], 99))
        rows += [
            Row(f"control step, {size} px, median", 1e3 * middle["ours"], "ms", **beside, **limit),
            Row(f"control step, {size} px, 99th percentile", 1e3 * tail, "ms"),
        ]
    return rows


if __name__ == "__main__":
    run(parser_for(__doc__, turns=300), measure)
