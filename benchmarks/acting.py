"""Latency of a control step, median and 99th percentile, beside encoding the whole window anew.

    python benchmarks/acting.py

One episode, one step after the other, policies of the paper's width: what `select_action` takes. Beside it, the published
scheme, which encodes the ten frames of its window at every step; the limit is the ResNet's forward pass for one frame.
"""

from collections.abc import Callable

import torch
from common import Row, in_turns, machine, medians, parser_for, report
from policies import CAMERA, make_policy, random_observations
from reference import Reference, random_windows

WANTED = {224: (35.0, 50.0), 84: (12.0, None)}  # ms: median, 99th percentile
TIMES_WANTED = 10


def stepper(image_size: int) -> Callable[[], object]:
    """A control step of an episode."""
    policy = make_policy(image_size=image_size).eval()
    policy.reset()
    observations = random_observations(policy.config, 32)
    step = 0

    def act() -> None:
        nonlocal step
        step += 1
        with torch.inference_mode():  # as lerobot-eval does
            policy.select_action(observations[step % 32])

    return act


def re_encoder() -> Callable[[], object]:
    """A control step of the published scheme."""
    model = Reference().eval()
    images, sound, state, _ = random_windows(1)

    def act() -> None:
        with torch.inference_mode():
            model(images, sound, state)

    return act


def bare_resnet(image_size: int) -> Callable[[], object]:
    """The plain ResNet's forward pass for one frame, its weights laid out beforehand."""
    policy = make_policy(use_audio=False).eval()
    encoder = policy.model.vision[CAMERA.removeprefix("observation.").replace(".", "_")]
    network = encoder.network.to(memory_format=torch.channels_last)
    frame = torch.rand(1, 9, image_size, image_size).contiguous(memory_format=torch.channels_last)

    def run() -> None:
        with torch.inference_mode():
            network(frame)

    return run


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--turns", type=int, default=300)
    args = parser.parse_args()
    started, rows = machine(), []
    re_encode = re_encoder()
    alternative = medians(in_turns({"re-encode": re_encode}, max(5, args.turns // 30)))["re-encode"]
    for size, (median_wanted, tail_wanted) in WANTED.items():
        works = {"ours": stepper(size), "bare": bare_resnet(size)}
        seconds = in_turns(works, args.turns, warm_up=20)
        middle = {name: 1e3 * value for name, value in medians(seconds).items()}
        tail = 1e3 * float(torch.tensor(seconds["ours"]).quantile(0.99))
        paper = size == 224
        if paper:  # again, so that the machine's mood hits both
            alternative = (alternative + medians(in_turns({"re-encode": re_encode}, 5))["re-encode"]) / 2
        times = 1e3 * alternative / middle["ours"]
        wanted = f"at most {median_wanted:g} ms" + (f", {TIMES_WANTED} times" if paper else "")
        holds = middle["ours"] <= median_wanted and (not paper or times >= TIMES_WANTED)
        rows.append(
            Row(
                f"control step, {size} px, median",
                middle["ours"],
                "ms",
                "encoding the window anew" if paper else "",
                1e3 * alternative if paper else None,
                "the ResNet alone",
                middle["bare"],
                wanted,
                holds,
            )
        )
        holds_tail = None if tail_wanted is None else tail < tail_wanted
        text = "" if tail_wanted is None else f"under {tail_wanted:g} ms"
        rows.append(Row(f"control step, {size} px, 99th percentile", tail, "ms", wanted=text, holds=holds_tail))
    report("acting", rows, args.output, started)


if __name__ == "__main__":
    main()
