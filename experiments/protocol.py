"""What every figure about learning is measured by: seeds, conditions, intervals, and the files of the results.

Three ranges of environment seeds never meet: demonstrations are recorded from the first, every choice was made on the
second, and the third is for the figures that are reported and for nothing else.
"""

import json
import math
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

TASKS = ("OccludedGrasp-v0", "OccludedPickPlace-v0")
DEMONSTRATION_SEED = 0  # recording counts up from here, below 1000
EVALUATION_SEEDS = range(70000, 70100)
DONOR_SEEDS = range(60000, 60040)  # expert episodes whose sounds the listening probes play
TRAINING_SEEDS = (1, 2, 3)
N_DEMONSTRATIONS = 50
ATTEMPT_STEPS = {"OccludedGrasp-v0": 220, "OccludedPickPlace-v0": 300}  # enough to search a second time
RUN_LENGTHS = (1, 8, 16)  # windows per run
STEPS = {"OccludedGrasp-v0": 3000, "OccludedPickPlace-v0": 3000}

CONDITIONS: dict[str, tuple[str, ...]] = {
    "full": (),
    "deaf": ("--policy.use_audio=false",),
    "sightless": ("--policy.use_vision=false",),
    "memoryless": ("--policy.use_memory=false",),
}

RESULTS = Path(__file__).parent / "results"
RUNS = Path(os.environ.get("PLAYBYEAR_RUNS", "outputs/experiments"))


@dataclass
class Result:
    """Success of one policy over the evaluation seeds.

    Attributes:
        task, condition: What was learned, and with which senses.
        training_seed: Of network, batches and augmentation.
        n_demonstrations, steps: What it was trained on, and for how many updates.
        first_seed: Of the evaluation's episodes; they count up.
        successes: Of each episode.
        minutes: Of training, on `threads` threads.
        commands: What was run, in order.
        environment: Options of the environment where they differ from the task's own.
        versions: Of the libraries that matter.
    """

    task: str
    condition: str
    training_seed: int
    n_demonstrations: int
    steps: int
    first_seed: int
    successes: list[bool]
    minutes: float
    threads: int
    commands: list[str]
    environment: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=lambda: library_versions())

    @property
    def rate(self) -> float:
        return sum(self.successes) / len(self.successes)

    def save(self, path: Path) -> None:
        """Writes the result as JSON, all of it or nothing."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(asdict(self)) + "\n")
        partial.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Result":
        return cls(**json.loads(path.read_text()))


def load_results(pattern: str) -> list[Result]:
    """The saved results whose file below `RESULTS` matches a glob pattern, in the order of their names."""
    return [Result.load(path) for path in sorted(RESULTS.glob(pattern))]


def wilson_interval(n_successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """The 95 % interval of a rate (Wilson, 1927); unlike the normal one it holds near 0 and 1."""
    rate, z2 = n_successes / n, z * z
    centre = (rate + z2 / (2 * n)) / (1 + z2 / n)
    half = z / (1 + z2 / n) * math.sqrt(rate * (1 - rate) / n + z2 / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def library_versions() -> dict[str, str]:
    return {name: version(name) for name in ("lerobot", "torch", "mujoco")}


def tool(name: str) -> str:
    """A command that is installed beside this Python."""
    return str(Path(sys.executable).with_name(name))


def run(command: list[str], log: Path, threads: int) -> None:
    """Runs a command, its output in a file.

    Raises:
        RuntimeError: It failed; the message ends with its last lines.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    with log.open("a") as file:
        code = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, env=environment, check=False).returncode
    if code:
        tail = "\n".join(log.read_text(errors="replace").replace("\r", "\n").splitlines()[-15:])
        raise RuntimeError(f"{shown(command)} ended with {code}; {log} ends with\n{tail}")


def shown(command: list[str]) -> str:
    """A command as a person would type it: without the folders of this machine."""
    return " ".join([Path(command[0]).name, *(arg.replace(f"{RUNS}/", "outputs/experiments/") for arg in command[1:])])


def dataset_root(task: str) -> Path:
    return RUNS / "datasets" / task


def record(task: str, n_episodes: int, root: Path | None = None) -> str:
    """Records demonstrations, or as many as are missing; returns the command.

    Args:
        task: What the expert does.
        n_episodes: How many there shall be.
        root: The dataset's folder; by default the task's own.
    """
    root = root or dataset_root(task)
    command = [
        tool("playbyear-record"),
        "--env.type=playbyear",
        f"--env.task={task}",
        f"--dataset.repo_id=experiments/{root.name}",
        f"--dataset.root={root}",
        f"--dataset.num_episodes={n_episodes}",
        f"--seed={DEMONSTRATION_SEED}",
        "--resume=true",
    ]
    run(command, RUNS / "logs" / f"record-{root.name}.log", threads=1)
    return shown(command)
