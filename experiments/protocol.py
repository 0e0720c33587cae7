"""What every figure about learning is measured by: seeds, conditions, intervals, and the files of the results.

Three ranges of environment seeds never meet: demonstrations are recorded from the first, every choice was made on the
second, and the third is for the figures that are reported and for nothing else.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

TASKS = ("OccludedGrasp-v0", "OccludedPickPlace-v0")
NEW_TASKS = ("OccludedGrasp-v1", "OccludedPickPlace-v1", "TellApart-v1", "KeyBag-Easy-v1", "KeyBag-Hard-v1")
FPS = {"TellApart-v1": 5, "KeyBag-Easy-v1": 5, "KeyBag-Hard-v1": 5}  # where it is not 20 [Hz]
DEMONSTRATION_SEED = 0  # recording counts up from here, below 1000
EVALUATION_SEEDS = range(70000, 70100)
DONOR_SEEDS = range(60000, 60040)  # expert episodes whose sounds the listening probes play
TRAINING_SEEDS = (1, 2, 3)
N_DEMONSTRATIONS = 50
ATTEMPT_STEPS = {"OccludedGrasp-v0": 220, "OccludedPickPlace-v0": 300}  # enough to search a second time
RUN_LENGTHS = (1, 8, 16)  # windows per run
STEPS = 1250

CONDITIONS: dict[str, tuple[str, ...]] = {
    "full": (),
    "deaf": ("--policy.use_audio=false",),
    "sightless": ("--policy.use_vision=false",),
    "memoryless": ("--policy.use_memory=false",),
}

_OPTIONS: dict[str, dict[str, Any]] = {
    "task": {"choices": TASKS + NEW_TASKS, "default": TASKS[0]},
    "seeds": {"nargs": "+", "type": int, "default": TRAINING_SEEDS, "help": "of the policies' training"},
    "jobs": {"type": int, "default": 1, "help": "policies that are trained side by side"},
    "threads": {"type": int, "default": 1, "help": "per policy"},
    "steps": {"type": int, "default": STEPS, "help": "updates of a training"},
    "output": {"type": Path, "default": Path("docs/media")},
}

RESULTS = Path(__file__).parent / "results"
RUNS = Path(os.environ.get("PLAYBYEAR_RUNS", "outputs/experiments"))


def command_line(doc: str | None, *options: str) -> argparse.ArgumentParser:
    """A command line that prints the module's docstring as help, with some of the options that the studies share."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option in options:
        parser.add_argument(f"--{option}", **_OPTIONS[option])
    return parser


class Tally:
    """What is counted in the attempts of an evaluation; the attributes are those of `Result`."""

    successes: list[bool]
    acted_early: list[bool]
    ends: list[str]
    n_closings: list[int]
    contents: list[str]

    @property
    def rate(self) -> float:
        return sum(self.successes) / len(self.successes)

    @property
    def early_rate(self) -> float | None:
        """Share of the episodes in which the hand acted before anything was heard; None: nobody looked."""
        return sum(self.acted_early) / len(self.acted_early) if self.acted_early else None

    @property
    def first_search_rate(self) -> float | None:
        """Share of the episodes that were solved by the first closing of the hand; None: nobody counted."""
        first = [solved and n == 1 for solved, n in zip(self.successes, self.n_closings, strict=False)]
        return sum(first) / len(first) if first else None

    @property
    def failures(self) -> str:
        """How the failures ended, the most frequent first: `7 pressed, 2 time`; empty where nobody looked."""
        ends = Counter(end for solved, end in zip(self.successes, self.ends, strict=False) if not solved)
        return ", ".join(f"{n} {end}" for end, n in ends.most_common())

    @property
    def by_contents(self) -> str:
        """Success with each of the contents that there are: `peanuts 47 of 52, screws 42 of 48`; empty if there was one."""
        tried = Counter(self.contents)
        solved = Counter(what for success, what in zip(self.successes, self.contents, strict=False) if success)
        return ", ".join(f"{what} {solved[what]} of {n}" for what, n in sorted(tried.items())) if len(tried) > 1 else ""

    @property
    def summary(self) -> str:
        """Success, and how often the hand acted early, in a few words."""
        early = "" if self.early_rate is None else f" (acted early: {self.early_rate:.0%})"
        return f"{self.rate:.0%}{early} {self.by_contents}".strip()


@dataclass
class Result(Tally):
    """Success of one policy over the evaluation seeds.

    Attributes:
        task, condition: What was learned, and with which senses.
        training_seed: Of network, batches and augmentation.
        n_demonstrations, steps: What it was trained on, and for how many updates.
        first_seed: Of the evaluation's episodes; they count up.
        successes: Of each episode.
        minutes: Of training, on `threads` threads.
        commands: What was run, in order.
        acted_early: Of each episode: the hand acted before anything was heard. Empty where nobody looked: in results from
            before, and in tasks that do not tell.
        ends: How each episode ended, the environment's `info["end"]`; empty likewise.
        n_closings: How often the hand closed in each; empty likewise.
        contents: What was in the pouch in each; empty likewise.
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
    acted_early: list[bool] = field(default_factory=list)
    ends: list[str] = field(default_factory=list)
    n_closings: list[int] = field(default_factory=list)
    contents: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=lambda: library_versions())


def save(path: Path, content: Any, indent: int | None = None) -> None:
    """Writes JSON, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=indent) + "\n")
    partial.replace(path)


def load(path: Path) -> Any:
    """What a JSON file holds."""
    return json.loads(path.read_text())


def load_results(pattern: str) -> list[Result]:
    """The saved results whose file below `RESULTS` matches a glob pattern, in the order of their names."""
    return [Result(**load(path)) for path in sorted(RESULTS.glob(pattern))]


def load_demonstrations(task: str) -> list[Result]:
    """The results over the number of demonstrations, with those that other studies have for the same training seed.

    Most full policies were trained with the quieter noise that the preset had then, so these come first.
    """
    places = ("ablations/{}", "demonstrations/{}", "presets/{}-full-quieter_noise", "demonstrations-quieter_noise/{}")
    found, seeds = {}, set()
    for place in places:  # of the same training the last one counts
        for result in load_results(f"{place.format(task)}-*demos-*.json"):
            found[result.condition, result.n_demonstrations, result.training_seed] = result
            if place.startswith("demonstrations"):
                seeds.add(result.training_seed)
    return [result for result in found.values() if result.training_seed in seeds]


def blind_path(task: str) -> Path:
    """The file of what scripts reach that feel nothing, and of the expert."""
    return RESULTS / "ablations" / f"{task}-blind.json"


def wilson_interval(n_successes: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """The 95 % interval of a rate (Wilson, 1927); unlike the normal one it holds near 0 and 1."""
    rate, z2 = n_successes / n, z * z
    centre = (rate + z2 / (2 * n)) / (1 + z2 / n)
    half = z / (1 + z2 / n) * math.sqrt(rate * (1 - rate) / n + z2 / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def library_versions() -> dict[str, str]:
    return {name: version(name) for name in ("lerobot", "torch", "mujoco")}


def run(command: list[str], name: str, threads: int) -> None:
    """Runs a command that is installed beside this Python, its output in a log of this name.

    Raises:
        RuntimeError: It failed; the message ends with its last lines.
    """
    log = RUNS / "logs" / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {"MUJOCO_GL": "egl", **os.environ, "OMP_NUM_THREADS": str(threads)}
    program = str(Path(sys.executable).with_name(command[0]))
    with log.open("a") as file:
        done = subprocess.run(
            [program, *command[1:]], stdout=file, stderr=subprocess.STDOUT, env=environment, check=False
        )
    if done.returncode:
        tail = "\n".join(log.read_text(errors="replace").replace("\r", "\n").splitlines()[-15:])
        raise RuntimeError(f"{shown(command)} ended with {done.returncode}; {log} ends with\n{tail}")


def shown(command: list[str]) -> str:
    """A command as a person would type it: without the folders of this machine."""
    return " ".join(command).replace(f"{RUNS}/", "outputs/experiments/")


def dataset_root(task: str) -> Path:
    return RUNS / "datasets" / task


def options_of(dataset: Path, kind: str = "dataset") -> list[str]:
    """The options that name a dataset."""
    return [f"--{kind}.repo_id=experiments/{dataset.name}", f"--{kind}.root={dataset}"]


def record(task: str, n_episodes: int, root: Path | None = None, *environment: str) -> None:
    """Records demonstrations, or as many as are missing.

    Args:
        task: What the expert does.
        n_episodes: How many there are to be.
        root: The dataset's folder; by default the task's own.
        environment: Further options of the environment, `--env.image_size=48`.
    """
    root = root or dataset_root(task)
    info = root / "meta" / "info.json"
    missing = n_episodes - (load(info)["total_episodes"] if info.is_file() else 0)
    if missing <= 0:
        return
    command = [
        "playbyear-record",
        "--env.type=playbyear",
        f"--env.task={task}",
        *options_of(root),
        f"--dataset.num_episodes={missing}",
        f"--seed={DEMONSTRATION_SEED}",
        "--resume=true",
        *environment,
    ]
    run(command, f"record-{root.name}", threads=1)
