"""Windows per second of `playbyear-train` in two processes, beside one; one thread each, on two cores that do nothing else.

    python benchmarks/processes.py

Both train from the same store with as many runs per process, through `accelerate launch`. The rate is that of the log, from the
fifth update on. What the machine allows is the sum of two trainings at the same time that know nothing of each other.
"""

import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from common import Row, machine, parser_for, report
from scenes import dataset_features, frames

from lerobot_playbyear.datasets.durable import DurableWriter

REPO_ID, FPS, SAMPLE_RATE = "benchmark/processes", 20, 16000
WANTED = 1.8
_RUNS, _K, _FIRST = 8, 8, 5


def record(root: Path, image_size: int) -> None:
    """Writes four episodes with one camera and one microphone."""
    features = dataset_features((image_size, image_size), SAMPLE_RATE, FPS)
    with DurableWriter(REPO_ID, root, FPS, features) as writer:
        for episode in range(4):
            for frame in frames(features, 80, seed=episode):
                writer.add_frame(frame)
            writer.save_episode()


def windows_per_second(n_processes: int, root: Path, output: Path, image_size: int, steps: int) -> float:
    """Of all processes together."""
    folder = Path(sys.executable).parent
    command = [
        *(
            str(folder / "playbyear-train"),
            "--policy.type=playbyear",
            "--policy.device=cpu",
            "--policy.push_to_hub=false",
        ),
        *(f"--policy.image_size={image_size}", "--policy.vision_width=16", f"--policy.n_supervised_steps={_K}"),
        *(f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}", f"--batch_size={_RUNS}", f"--steps={steps}"),
        *("--log_freq=1", "--save_checkpoint=false", f"--output_dir={output}"),
    ]
    if n_processes > 1:
        several = ("--multi_gpu", f"--num_processes={n_processes}", "--num_machines=1", "--main_process_port=0")
        launcher = [str(folder / "accelerate"), "launch", *several, "--mixed_precision=no", "--dynamo_backend=no"]
        command = [*launcher, *command]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    lines = [json.loads(line) for line in (output / "metrics.jsonl").read_text().splitlines()]
    first, last = lines[_FIRST - 1], lines[-1]
    updates = last["step"] - first["step"]
    return n_processes * _RUNS * _K * updates / (last["elapsed_s"] - first["elapsed_s"])


def main() -> None:
    parser = parser_for(__doc__, turns=3)
    parser.add_argument("--image_size", type=int, default=84, help="pixels")
    parser.add_argument("--steps", type=int, default=60, help="updates")
    args = parser.parse_args()
    started = machine()
    rates: dict[int, list[float]] = {1: [], 2: []}
    apart: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder / "data", args.image_size)
        for turn in range(args.turns):
            for n, measured in rates.items():
                output = folder / f"{n}-{turn}"
                measured.append(windows_per_second(n, folder / "data", output, args.image_size, args.steps))
            with ThreadPoolExecutor() as pool:
                places = [folder / f"apart{which}-{turn}" for which in range(2)]
                work = [
                    pool.submit(windows_per_second, 1, folder / "data", p, args.image_size, args.steps) for p in places
                ]
                apart.append(sum(each.result() for each in work))
    one, two = (sorted(values)[len(values) // 2] for values in rates.values())
    row = Row(
        f"training in two processes, {args.image_size} px, width 16",
        two,
        "windows/s",
        beside="in one",
        theirs=one,
        limit_is="two trainings apart",
        limit=sorted(apart)[len(apart) // 2],
        wanted=f"at least {WANTED} times",
        holds=two >= WANTED * one,
    )
    report("processes", [row], args.output, started)


if __name__ == "__main__":
    main()
