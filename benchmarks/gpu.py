"""Training on a GPU: windows per second, and how much of the card is used.

    python benchmarks/gpu.py --root outputs/demos          # on a machine with an NVIDIA card
    python benchmarks/gpu.py --root outputs/demos --device=cpu --options="--batch_size=2 --policy.image_size=32 ..."

Makes updates as `playbyear-train --preset=gpu` does on those demonstrations: operations are counted by torch's FlopCounterMode
and divided by the time of an update; beside it stands the largest product of matrices that the card reaches in the same number
format. In five updates `torch.cuda.set_sync_debug_mode("warn")` tells the lines that wait for the card.
"""

import argparse
import itertools
import shlex
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from common import Row, parser_for, run
from lerobot.configs import parser as lerobot_parser
from lerobot.datasets import LeRobotDataset
from lerobot.utils.import_utils import register_third_party_plugins
from reference import Reference, random_windows
from torch.utils.flop_counter import FlopCounterMode
from training import update_of

from lerobot_playbyear.training import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.training.batches import PolicyWindows
from lerobot_playbyear.training.command_line import apply_preset
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import make_learner

REPO_ID = "benchmark/gpu"
MATRIX = {"cuda": 8192, "cpu": 512}
PUBLISHED_WINDOWS = {"cuda": 64, "cpu": 1}  # of an update


def wait(device: torch.device) -> None:
    """Until the card is done."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def seconds_each(work: Callable[[], object], device: torch.device, n: int = 10) -> float:
    """The mean time of a call, with the card waited for before and after all of them [s]."""
    wait(device)
    start = time.perf_counter()
    for _ in range(n):
        work()
    wait(device)
    return (time.perf_counter() - start) / n


def best_product(device: torch.device, dtype: torch.dtype) -> float:
    """The fastest product of two large matrices [TFLOP/s]."""
    n = MATRIX[device.type]
    a, b = (torch.randn(n, n, device=device, dtype=dtype) for _ in range(2))
    torch.matmul(a, b)
    return 2 * n**3 / seconds_each(lambda: torch.matmul(a, b), device) / 1e12


def waiting_lines(update: Callable[[], None], device: torch.device) -> set[str]:
    """Where the host waits for the card in some updates; each is printed. Empty on a machine without one."""
    if device.type != "cuda":
        return set()
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(5):
            update()
    torch.cuda.set_sync_debug_mode("default")
    lines = {f"{w.filename}:{w.lineno}" for w in caught if "synchroniz" in str(w.message)}
    print(*sorted(lines), sep="\n")
    return lines


def published(device: torch.device) -> float:
    """The published scheme's windows per second, its augmentation not counted: one by one it would cost the most."""
    model = Reference(augments=False).to(device).train()
    images, sound, state, action = (part.to(device) for part in random_windows(PUBLISHED_WINDOWS[device.type]))
    update = update_of(model, lambda: (model(images, sound, state) - action).square().mean())
    for _ in range(3):
        update()
    return len(images) / seconds_each(update, device)


def updates(options: list[str], plain: bool = False) -> list[Row]:
    """What an update costs, how much of it the card computes, and which part takes how long; plain: the first alone."""
    sys.argv[1:] = apply_preset(options)
    cfg = lerobot_parser.wrap()(_validated)()
    dataset = LeRobotDataset(REPO_ID, cfg.dataset.root)
    parts = make_learner(cfg, dataset.meta)
    device, windows = parts.accelerator.device, PolicyWindows(parts.policy.config, dataset.meta)
    store = EpisodeStore.from_dataset(dataset, windows.keys)
    sampler, numbers = RunSampler(run_weights(store, windows.n_windows)), itertools.count()

    def batch() -> dict:
        return windows.batch(store, sampler.draw(cfg.batch_size, next(numbers)))

    def update() -> None:
        parts.update(batch(), cfg.optimizer.grad_clip_norm)

    for _ in range(3):  # also compiles
        update()
    took = seconds_each(update, device)
    if plain:
        return [Row("an update, not compiled", 1e3 * took, "ms")]
    ready = parts.preprocessor(batch())

    def forward() -> torch.Tensor:
        with parts.accelerator.autocast():
            return parts.policy.forward(ready)[0]

    with FlopCounterMode(display=False) as counter:
        parts.accelerator.backward(forward())
    parts.optimizer.zero_grad()
    dtype = {"bf16": torch.bfloat16, "fp16": torch.float16}.get(parts.accelerator.mixed_precision, torch.float32)
    windows_per_second = cfg.batch_size * windows.n_windows / took
    beside = ("the published scheme without its augmentation, float32", published(device))
    product = {"limit_is": f"largest product of matrices, {dtype}", "limit": best_product(device, dtype)}
    operations = counter.get_total_flops() / took / 1e12
    return [
        Row("training, windows of the preset", windows_per_second, "windows/s", *beside),
        Row("operations of an update over its time", operations, "TFLOP/s", **product),
        Row("an update", 1e3 * took, "ms"),
        Row("lines of an update that wait for the card", len(waiting_lines(update, device)), ""),
    ]


def _validated(cfg: PlaybyearTrainConfig) -> PlaybyearTrainConfig:
    cfg.validate()
    return cfg


def measure(args: argparse.Namespace) -> list[Row]:
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("error: There is no NVIDIA GPU here; --device=cpu with small --options tries the script.")
    register_third_party_plugins()
    data = (f"--dataset.repo_id={REPO_ID}", f"--dataset.root={args.root}", f"--policy.device={args.device}")
    options = ["--preset=gpu", *data, *shlex.split(args.options)]
    return [*updates(options), *updates([*options, "--compile=false"], plain=True)]


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=1)
    parser.add_argument("--root", type=Path, required=True, help="demonstrations")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--options", default="", help="of playbyear-train, over the preset's")
    run(parser, measure)
