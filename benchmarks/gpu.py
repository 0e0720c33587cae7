"""Training on a GPU: the paper's number of windows, how much of the card is used, and where the rest goes.

    python benchmarks/gpu.py                              # on a machine with an NVIDIA card
    python benchmarks/gpu.py --device=cpu --demos=2 --rounds=1 --evaluations=2 --options="--steps=3 --batch_size=2 ..."

Records demonstrations, trains with `playbyear-train --preset=gpu`, evaluates, and corrects for some rounds. Then it
makes updates in this process: operations are counted by torch's FlopCounterMode and divided by the time of an update;
beside it stands the largest product of matrices that the card reaches in the same number format. Parts of an update
are timed one by one, with the card waited for in between, so that they add up to more than an update takes. In five
updates `torch.cuda.set_sync_debug_mode("warn")` tells the lines that wait for the card.
"""

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from common import Row, machine, parser_for, report
from lerobot.configs import parser as lerobot_parser
from lerobot.datasets import LeRobotDataset
from lerobot.utils.import_utils import register_third_party_plugins
from reference import Reference, random_windows
from torch.utils.flop_counter import FlopCounterMode
from training import update_of

from lerobot_playbyear.datasets import EpisodeStore, RunSampler, run_weights
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.parts import TrainingParts, make_training_parts
from lerobot_playbyear.training.presets import apply_preset
from lerobot_playbyear.training.windows import PolicyWindows

REPO_ID, TASK = "benchmark/gpu", "OccludedGrasp-v1"
WANTED_MINUTES = 5
# Small films: LeRobot renders some of every evaluation, and what people see of version 1 takes its time.
_ENV = (
    "--env.type=playbyear",
    f"--env.task={TASK}",
    "--env.visualization_width=96",
    "--env.visualization_height=96",
)
_UPDATES, _CHECKED = 10, 5
_MATRIX = {"cuda": 8192, "cpu": 512}
_PUBLISHED_WINDOWS = {"cuda": 64, "cpu": 1}  # of an update


def program(name: str, *options: str) -> float:
    """Runs one of the commands; how long it took [s]."""
    start = time.perf_counter()
    command = [str(Path(sys.executable).with_name(name)), *options]
    subprocess.run(command, check=True, env={**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")})
    return time.perf_counter() - start


def parts_of(options: list[str]) -> tuple[PlaybyearTrainConfig, LeRobotDataset, TrainingParts]:
    """What playbyear-train makes of its options."""
    sys.argv[1:] = apply_preset(options)

    @lerobot_parser.wrap()
    def configured(cfg: PlaybyearTrainConfig) -> PlaybyearTrainConfig:
        cfg.validate()
        return cfg

    cfg = configured()
    dataset = LeRobotDataset(REPO_ID, cfg.dataset.root)
    return cfg, dataset, make_training_parts(cfg, dataset.meta)


def wait(device: torch.device) -> None:
    """Until the card is done."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def seconds_each(work: Callable[[], object], device: torch.device, n: int = _UPDATES) -> float:
    """The mean time of a call, with the card waited for before and after all of them [s]."""
    wait(device)
    start = time.perf_counter()
    for _ in range(n):
        work()
    wait(device)
    return (time.perf_counter() - start) / n


def best_product(device: torch.device, dtype: torch.dtype) -> float:
    """The fastest product of two large matrices [TFLOP/s]."""
    n = _MATRIX[device.type]
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
        for _ in range(_CHECKED):
            update()
    torch.cuda.set_sync_debug_mode("default")
    lines = {f"{w.filename}:{w.lineno}" for w in caught if "synchroniz" in str(w.message)}
    print(*sorted(lines), sep="\n")
    return lines


def published(device: torch.device) -> float:
    """The published scheme's windows per second, its augmentation not counted: one by one it would cost the most."""
    model = Reference(augments=False).to(device).train()
    images, sound, state, action = (part.to(device) for part in random_windows(_PUBLISHED_WINDOWS[device.type]))
    update = update_of(model, lambda: (model(images, sound, state) - action).square().mean())
    for _ in range(3):
        update()
    return len(images) / seconds_each(update, device)


def updates(options: list[str], plain: bool = False) -> list[Row]:
    """What an update costs, how much of it the card computes, and which part takes how long; plain: the first alone."""
    cfg, dataset, parts = parts_of(options)
    device = parts.accelerator.device
    windows = PolicyWindows(parts.policy.config, dataset.meta)
    store = EpisodeStore.from_dataset(dataset, windows.keys)
    sampler = RunSampler(run_weights(store, windows.n_windows))
    assert cfg.optimizer is not None
    clip = cfg.optimizer.grad_clip_norm

    def batch() -> dict:
        return windows.batch(store, sampler.draw(cfg.batch_size))

    def update() -> None:
        parts.update(batch(), clip)

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
    pieces = {
        "cutting a batch": seconds_each(batch, device),
        "preprocessor": seconds_each(lambda: parts.preprocessor(batch()), device),
        "forward": seconds_each(forward, device),
        "forward and backward": seconds_each(lambda: parts.accelerator.backward(forward()), device),
        "optimizer": seconds_each(parts.optimizer.step, device),
    }
    n_windows = cfg.batch_size * windows.n_windows
    waits = waiting_lines(update, device)
    return [
        Row(
            "training, windows of the preset",
            n_windows / took,
            "windows/s",
            beside="the published scheme without its augmentation, float32",
            theirs=published(device),
        ),
        Row(
            "operations of an update over its time",
            counter.get_total_flops() / took / 1e12,
            "TFLOP/s",
            limit_is=f"largest product of matrices, {dtype}",
            limit=best_product(device, dtype),
        ),
        Row("an update", 1e3 * took, "ms"),
        Row("lines of an update that wait for the card", len(waits), "", wanted="none", holds=not waits),
        *(Row(f"... of it alone: {name}", 1e3 * seconds, "ms") for name, seconds in pieces.items()),
    ]


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--demos", type=int, default=50, help="episodes recorded, without --data")
    parser.add_argument("--data", type=Path, help="demonstrations that are there, instead of recording them")
    parser.add_argument("--seed", type=int, default=1, help="of the training")
    parser.add_argument("--evaluations", type=int, default=100, help="episodes")
    parser.add_argument("--rounds", type=int, default=5, help="of corrections")
    parser.add_argument("--options", default="", help="of playbyear-train, over the preset's")
    args = parser.parse_args()
    if args.device == "cuda" and not torch.cuda.is_available():
        sys.exit("error: There is no NVIDIA GPU here; --device=cpu with small --options tries the script.")
    register_third_party_plugins()
    started = machine()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={args.data or folder / 'data'}"]
        if args.data is None:
            program("playbyear-record", *_ENV, *data, f"--dataset.num_episodes={args.demos}", "--seed=0")
        device, own = f"--policy.device={args.device}", shlex.split(args.options)
        options = ["--preset=gpu", device, *data, *own]
        run = [f"--seed={args.seed}", "--env_eval_freq=0", f"--output_dir={folder / 'run'}"]
        seconds = program("playbyear-train", *options, *run)
        policy = folder / "run" / "checkpoints" / "last" / "pretrained_model"
        evaluation = [
            f"--eval.n_episodes={args.evaluations}",
            f"--eval.batch_size={min(10, args.evaluations)}",
            "--seed=60000",
        ]
        program("lerobot-eval", f"--policy.path={policy}", *_ENV, *evaluation, f"--output_dir={folder / 'eval'}")
        success = json.loads((folder / "eval" / "eval_info.json").read_text())["overall"]["pc_success"]
        corrections = [
            "--interventions.repo_id=benchmark/corrections",
            f"--interventions.root={folder / 'corrections'}",
        ]
        demos = [option.replace("--dataset", "--demos") for option in data]
        rounds = [
            f"--episodes={args.rounds}",
            "--warmup_episodes=1",
            "--eval_every=0",
            f"--output_dir={folder / 'dagger'}",
        ]
        program("playbyear-dagger", f"--policy.path={policy}", device, *demos, *corrections, *_ENV, *rounds)
        lines = [json.loads(line) for line in (folder / "dagger" / "metrics.jsonl").read_text().splitlines()]
        spent = [line["total_s"] for line in lines if line["kind"] == "round"]
        rows = [
            Row(
                "the preset's windows, from start to end",
                seconds / 60,
                "minutes",
                wanted=f"under {WANTED_MINUTES}",
                holds=seconds < 60 * WANTED_MINUTES,
            ),
            Row(f"success on {args.evaluations} episodes", success, "%"),
            *updates(options),
            *updates([*options, "--compile=false"], plain=True),
            Row("a round of HG-DAgger", sorted(spent)[len(spent) // 2], "s"),
        ]
    card = torch.cuda.get_device_name() if args.device == "cuda" else "none"
    report("gpu", rows, args.output, {**started, "card": card})


if __name__ == "__main__":
    main()
