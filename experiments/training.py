"""Train and evaluate one policy with the commands that everybody has; what is there already is kept."""

import json
import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path

from experiments.protocol import (
    CONDITIONS,
    EVALUATION_SEEDS,
    RESULTS,
    RUNS,
    Result,
    dataset_root,
    run,
    shown,
    tool,
)


@dataclass(frozen=True)
class Job:
    """One policy to train and to evaluate.

    Attributes:
        study: Folder of its result.
        options: Further options of `playbyear-train`.
        variant: What the options do, for the names of files; empty without any.
        dataset: Folder of a dataset that holds the demonstrations and no more. None: the first ones of the task's own.
    """

    study: str
    task: str
    condition: str
    training_seed: int
    n_demonstrations: int
    steps: int
    threads: int = 1
    evaluation_seeds: range = EVALUATION_SEEDS
    options: tuple[str, ...] = field(default=())
    variant: str = ""
    dataset: Path | None = None

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
    if job.result_path.exists():
        return Result.load(job.result_path)
    train_command, minutes = train(job)
    commands = [train_command]
    successes = evaluate(job, commands)
    result = Result(
        task=job.task,
        condition=job.condition,
        training_seed=job.training_seed,
        n_demonstrations=job.n_demonstrations,
        steps=job.steps,
        first_seed=job.evaluation_seeds.start,
        successes=successes,
        minutes=round(minutes, 1),
        threads=job.threads,
        commands=commands,
    )
    result.save(job.result_path)
    return result


def train(job: Job) -> tuple[str, float]:
    """Trains the policy, or goes on where it was interrupted.

    Returns:
        The command, and the minutes that its training took in all.
    """
    folder = RUNS / "train" / job.name
    command = [
        tool("playbyear-train"),
        "--preset=cpu",
        *_demonstrations(job),
        f"--output_dir={folder}",
        f"--steps={job.steps}",
        "--save_freq=500",
        "--env_eval_freq=0",
        f"--seed={job.training_seed}",
        "--wandb.enable=false",
        *CONDITIONS[job.condition],
        *job.options,
    ]
    clock = folder.with_suffix(".minutes")
    spent = float(clock.read_text()) if clock.exists() else 0.0
    if not (folder / "checkpoints" / str(job.steps).zfill(6)).exists():
        last = folder / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        resume = [tool("playbyear-train"), "--resume=true", f"--config_path={last}"]
        if folder.exists() and not last.exists():  # interrupted before its first checkpoint
            shutil.rmtree(folder)
        start = time.monotonic()
        run(resume if last.exists() else command, RUNS / "logs" / f"train-{job.name}.log", job.threads)
        spent += (time.monotonic() - start) / 60
        clock.write_text(str(spent))
    return shown(command).replace(
        json.dumps(list(range(job.n_demonstrations))), f"[0..{job.n_demonstrations - 1}]"
    ), spent


def _demonstrations(job: Job) -> list[str]:
    folder = job.dataset or dataset_root(job.task)
    options = [f"--dataset.repo_id=experiments/{folder.name}", f"--dataset.root={folder}"]
    if job.dataset is None:
        options.append(f"--dataset.episodes={json.dumps(list(range(job.n_demonstrations)))}")
    return options


def evaluate(
    job: Job, commands: list[str], *environment: str, name: str | None = None, checkpoint: Path | None = None
) -> list[bool]:
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
    command = [
        tool("lerobot-eval"),
        f"--policy.path={checkpoint or job.checkpoint}",
        "--env.type=playbyear",
        f"--env.task={job.task}",
        f"--eval.n_episodes={len(job.evaluation_seeds)}",
        "--eval.batch_size=25",
        "--eval.use_async_envs=false",
        f"--seed={job.evaluation_seeds.start}",
        f"--output_dir={output}",
        *environment,
    ]
    run(command, RUNS / "logs" / f"eval-{label}.log", job.threads)
    commands.append(shown(command))
    report = json.loads((output / "eval_info.json").read_text())
    return [bool(success) for success in report["per_task"][0]["metrics"]["successes"]]
