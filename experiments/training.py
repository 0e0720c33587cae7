"""Train and evaluate one policy with the commands that everybody has; what is there already is kept."""

import json
import shutil
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from experiments.protocol import (
    CONDITIONS,
    EVALUATION_SEEDS,
    FPS,
    N_DEMONSTRATIONS,
    RESULTS,
    RUNS,
    STEPS,
    Result,
    Tally,
    dataset_root,
    load,
    options_of,
    run,
    save,
    shown,
)


@dataclass(frozen=True)
class Evaluation(Tally):
    """What a policy's attempts came to, in the order of their seeds; the names are those of `Result`."""

    successes: list[bool]
    acted_early: list[bool] = field(default_factory=list)
    ends: list[str] = field(default_factory=list)
    n_closings: list[int] = field(default_factory=list)
    contents: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Job:
    """One policy to train and to evaluate.

    Attributes:
        study: Folder of its result.
        start: The options of `playbyear-train` that say what a training begins with.
        options: Further ones.
        variant: What the options do, for the names of files; empty without any.
        dataset: Folder of a dataset that holds the demonstrations and no more. None: the first ones of the task's own.
    """

    study: str
    task: str
    condition: str
    training_seed: int
    n_demonstrations: int = N_DEMONSTRATIONS
    steps: int = STEPS
    threads: int = 1
    evaluation_seeds: range = EVALUATION_SEEDS
    start: tuple[str, ...] = ("--preset=cpu", "--save_freq=500")
    options: tuple[str, ...] = ()
    variant: str = ""
    dataset: Path | None = None

    @property
    def learned(self) -> dict[str, Any]:
        """What its result says of the policy."""
        names = ("task", "condition", "training_seed", "n_demonstrations", "steps")
        return {name: getattr(self, name) for name in names}

    @property
    def name(self) -> str:
        parts = [self.task, self.condition, self.variant, f"{self.n_demonstrations}demos", f"{self.steps}steps"]
        return "-".join([*filter(None, parts), f"seed{self.training_seed}"])

    @property
    def checkpoint(self) -> Path:
        return RUNS / "train" / self.name / "checkpoints" / "last" / "pretrained_model"

    @property
    def result_path(self) -> Path:
        return RESULTS / self.study / f"{self.name}.json"


def train_and_evaluate(job: Job) -> Result:
    """Trains, evaluates and saves the result; returns the saved one if there is one."""
    if not job.result_path.exists():
        command, minutes = train(job)
        commands = [command]
        result = Result(
            **job.learned,
            first_seed=job.evaluation_seeds.start,
            **asdict(evaluate(job, commands)),
            minutes=round(minutes, 1),
            threads=job.threads,
            commands=commands,
        )
        save(job.result_path, asdict(result))
    return Result(**load(job.result_path))


def side_by_side(jobs: Sequence[Job], n: int) -> Iterator[Result]:
    """Trains and evaluates n policies at a time; the results come in the order of the jobs."""
    with ThreadPoolExecutor(n) as pool:
        yield from pool.map(train_and_evaluate, jobs)


def train(job: Job) -> tuple[str, float]:
    """Trains the policy, or goes on where it was interrupted.

    Returns:
        The command, and the minutes that its training took in all.
    """
    folder = RUNS / "train" / job.name
    episodes, named = str(list(range(job.n_demonstrations))), f"[0..{job.n_demonstrations - 1}]"
    command = [
        "playbyear-train",
        *job.start,
        *options_of(job.dataset or dataset_root(job.task)),
        *([] if job.dataset else [f"--dataset.episodes={episodes}"]),
        f"--output_dir={folder}",
        f"--steps={job.steps}",
        "--env_eval_freq=0",
        f"--seed={job.training_seed}",
        "--wandb.enable=false",
        *CONDITIONS[job.condition],
        *([f"--policy.fps={FPS[job.task]}"] if job.task in FPS else []),
        *job.options,
    ]
    todo = command
    last = folder / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    if (folder / "checkpoints" / f"{job.steps:06}").exists():
        todo = []
    elif last.exists():
        todo = ["playbyear-train", "--resume=true", f"--config_path={last}"]
    elif folder.exists():  # interrupted before its first checkpoint
        shutil.rmtree(folder)
    return shown(command).replace(episodes, named), clocked(todo, folder, job.threads)


def clocked(command: list[str], folder: Path, threads: int) -> float:
    """Runs a command that can go on where it stopped, if there is one.

    Args:
        command: What is to run; empty if all of it is done.
        folder: What it writes to; a file beside it keeps the time.
        threads: For the command.

    Returns:
        The minutes that it took in all.
    """
    clock = folder.with_name(f"{folder.name}.minutes")
    spent = float(clock.read_text()) if clock.exists() else 0.0
    if command:
        start = time.monotonic()
        run(command, f"{command[0]}-{folder.name}", threads)
        spent += (time.monotonic() - start) / 60
        clock.write_text(str(spent))
    return spent


def evaluate(
    job: Job, commands: list[str], *environment: str, name: str | None = None, checkpoint: Path | None = None
) -> Evaluation:
    """Rolls a trained policy out over the job's evaluation seeds.

    Args:
        job: What was trained.
        commands: The command is appended to these.
        environment: Further options of the environment, `--env.noise_level=2`.
        name: Of this evaluation's folder and log.
        checkpoint: Another policy than the job's.
    """
    label = f"{name or job.study}-{job.name}"
    output = RUNS / "eval" / label
    attempts = output / "attempts.jsonl"
    attempts.unlink(missing_ok=True)
    command = [
        "lerobot-eval",
        f"--policy.path={checkpoint or job.checkpoint}",
        "--env.type=playbyear",
        f"--env.task={job.task}",
        f"--env.attempts_file={attempts}",
        f"--eval.n_episodes={len(job.evaluation_seeds)}",
        "--eval.batch_size=25",
        "--eval.use_async_envs=false",
        f"--seed={job.evaluation_seeds.start}",
        f"--output_dir={output}",
        *environment,
    ]
    run(command, f"eval-{label}", job.threads)
    commands.append(shown(command))
    report = load(output / "eval_info.json")
    successes = [bool(success) for success in report["per_task"][0]["metrics"]["successes"]]
    keys = {"acted_early": "acted_early", "ends": "end", "n_closings": "n_closings", "contents": "contents"}
    told = {name: told_of_attempts(attempts, key, job.evaluation_seeds) for name, key in keys.items()}
    return Evaluation(successes, **told)


def told_of_attempts(path: Path, key: str, seeds: range) -> list[Any]:
    """What a file of attempts says of those with these seeds, in their order; empty where one does not tell."""
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    told = {line["seed"]: line[key] for line in lines if key in line}
    return [told[seed] for seed in seeds] if all(seed in told for seed in seeds) else []
