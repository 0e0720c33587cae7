"""What corrections are worth: a middling policy, the same after HG-DAgger, and after as many updates without it.

    python -m experiments.corrections --task=OccludedGrasp-v0

1. A policy is trained on five demonstrations.
2. `playbyear-dagger` keeps 25 attempts in which the expert had to help, and learns from them as they come. These attempts may
   take longer than the task's own, so that the expert has the time to search anew after a mistake.
3. The control goes on with the same demonstrations, for as many updates at the same largest rate.

All three are evaluated on the same 50 seeds: in the task's own time, and in that of the attempts, which suffices for a second
try. Resumes where it was interrupted.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.protocol import (
    ATTEMPT_STEPS,
    CONDITIONS,
    EVALUATION_SEEDS,
    RESULTS,
    RUNS,
    TASKS,
    library_versions,
    record,
    run,
    shown,
    tool,
)
from experiments.training import Job, evaluate, train

STUDY = "corrections"
SEEDS = range(EVALUATION_SEEDS.start, EVALUATION_SEEDS.start + 50)
N_EPISODES = 25
EVERY = 10  # kept attempts between evaluations
BATCH_SIZE = 12


@dataclass
class Corrected:
    """One policy's way through corrections.

    Attributes:
        task, training_seed, n_demonstrations, steps: How the policy came to be that is corrected.
        first_seed, n_episodes: Of every evaluation.
        evaluations: Over the kept attempts and the updates, the percentages of successes: `success` in the time of the
            attempts, `in_task_time`, of the first and the last policy, in the task's own.
        attempts: Seed, outcome and share of interventions of each.
        updates: Of HG-DAgger, and of the control.
        control: The percentages of successes of the control.
        minutes: Of HG-DAgger, and of the control's training.
        seconds: Where the time of the rounds that made updates went, in all; `total_s` is their length.
        commands: What was run, in order.
        condition: With which senses the policy learns, before and after.
        versions: Of the libraries that matter.
    """

    task: str
    training_seed: int
    n_demonstrations: int
    steps: int
    first_seed: int
    n_episodes: int
    evaluations: list[dict[str, float]]
    attempts: list[dict[str, Any]]
    updates: int
    control: dict[str, float]
    minutes: dict[str, float]
    seconds: dict[str, float]
    commands: list[str]
    condition: str = "full"
    versions: dict[str, str] = field(default_factory=library_versions)

    @property
    def kind(self) -> tuple[str, int, int]:
        """What the policies of all training seeds have in common."""
        return self.condition, self.n_demonstrations, self.steps


def load_corrections(task: str) -> list[Corrected]:
    """The saved results of a task: those of one kind follow each other, in the order of their training seeds."""
    paths = (RESULTS / STUDY).glob(f"{task}-*.json")
    results = [Corrected(**json.loads(path.read_text())) for path in paths]
    return sorted(results, key=lambda result: (result.condition != "full", result.kind, result.training_seed))


def correct(job: Job) -> Corrected:
    """Runs all three parts, or what is missing of them."""
    assert job.dataset is not None
    demonstrations, threads = job.dataset, job.threads
    train_command, _ = train(job)
    folder = RUNS / "dagger" / job.name
    dagger = [
        tool("playbyear-dagger"),
        f"--policy.path={job.checkpoint}",
        f"--demos.repo_id=experiments/{demonstrations.name}",
        f"--demos.root={demonstrations}",
        f"--interventions.repo_id=experiments/corrections-{job.name}",
        f"--interventions.root={RUNS / 'datasets' / f'corrections-{job.name}'}",
        "--env.type=playbyear",
        f"--env.task={job.task}",
        f"--env.episode_length={ATTEMPT_STEPS[job.task]}",
        f"--episodes={N_EPISODES}",
        f"--batch_size={BATCH_SIZE}",
        f"--seed={job.training_seed}",
        "--eval_every=0",
        f"--save_every={EVERY}",
        f"--output_dir={folder}",
        "--resume=true",
    ]
    spent = _clocked(dagger, folder, threads)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    updates = max(line["step"] for line in lines)
    rounds = [line for line in lines if line["kind"] == "round" and "n_updates" in line]
    parts = {name for line in rounds for name in line if name.endswith("_s")}
    attempts = [
        {key: line[key] for key in ("seed", "outcome", "intervention_share")}
        for line in lines
        if line["kind"] == "attempt"
    ]
    commands = [train_command, shown(dagger)]
    milestones = {line["round"]: line["step"] for line in rounds if line["round"] % EVERY == 0 or line is rounds[-1]}
    first = _evaluations(job, commands, "0", job.checkpoint, is_end=True)
    evaluations = [{"kept": 0, "updates": 0, **first}]
    for kept, step in milestones.items():
        checkpoint = folder / "checkpoints" / f"{step:06}" / "pretrained_model"
        success = _evaluations(job, commands, str(kept), checkpoint, is_end=kept == max(milestones))
        evaluations.append({"kept": kept, "updates": step, **success})

    control_job = replace(job, steps=updates, variant=f"control-of-{job.steps}steps")
    go_on = [
        tool("playbyear-train"),
        f"--policy.path={job.checkpoint}",
        f"--dataset.repo_id=experiments/{demonstrations.name}",
        f"--dataset.root={demonstrations}",
        f"--output_dir={RUNS / 'train' / control_job.name}",
        f"--steps={updates}",
        f"--save_freq={updates}",
        "--env_eval_freq=0",
        f"--batch_size={BATCH_SIZE}",
        "--policy.push_to_hub=false",
        f"--seed={job.training_seed}",
        "--wandb.enable=false",
    ]
    clock = RUNS / "train" / control_job.name
    control_spent = _minutes(clock) if control_job.checkpoint.exists() else _clocked(go_on, clock, threads)
    commands.append(shown(go_on))
    control = _evaluations(control_job, commands, "control", control_job.checkpoint, is_end=True)
    return Corrected(
        task=job.task,
        training_seed=job.training_seed,
        n_demonstrations=job.n_demonstrations,
        steps=job.steps,
        first_seed=SEEDS.start,
        n_episodes=len(SEEDS),
        evaluations=evaluations,
        attempts=attempts,
        updates=updates,
        control=control,
        minutes={"dagger": round(spent, 1), "control": round(control_spent, 1)},
        seconds={name: round(sum(line.get(name, 0.0) for line in rounds), 1) for name in sorted(parts)},
        commands=commands,
        condition=job.condition,
    )


def _evaluations(job: Job, commands: list[str], name: str, checkpoint: Path, is_end: bool) -> dict[str, float]:
    """Percentages of successes in the time of the attempts, and where a policy ends also in the task's own."""
    times: dict[str, tuple[str, ...]] = {"success": (f"--env.episode_length={ATTEMPT_STEPS[job.task]}",)}
    if is_end:
        times["in_task_time"] = ()
    rates = {}
    for key, options in times.items():
        successes = evaluate(job, commands, *options, name=f"{STUDY}-{name}-{key}", checkpoint=checkpoint)
        rates[key] = 100 * sum(successes) / len(successes)
    return rates


def _clocked(command: list[str], folder: Path, threads: int) -> float:
    """Runs a command that can go on where it stopped; returns the minutes that it took in all."""
    spent = _minutes(folder)
    clock = _clock(folder)
    clock.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    run(command, RUNS / "logs" / f"{Path(command[0]).name}-{folder.name}.log", threads)
    spent += (time.monotonic() - start) / 60
    clock.write_text(str(spent))
    return spent


def _clock(folder: Path) -> Path:
    return folder.with_name(folder.name + ".minutes")


def _minutes(folder: Path) -> float:
    """What was spent on it so far."""
    return float(_clock(folder).read_text()) if _clock(folder).exists() else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default=TASKS[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], help="of training")
    parser.add_argument("--n_demonstrations", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000, help="updates of the policy that is corrected")
    parser.add_argument("--condition", choices=CONDITIONS, default="full", help="senses of the policy")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    record(options.task, options.n_demonstrations)
    demonstrations = RUNS / "datasets" / f"{options.task}-{options.n_demonstrations}"
    record(options.task, options.n_demonstrations, demonstrations)
    for seed in options.seeds:
        number, steps = options.n_demonstrations, options.steps
        job = Job(
            *(STUDY, options.task, options.condition, seed, number, steps, options.threads, SEEDS),
            dataset=demonstrations,
        )
        if not job.result_path.exists():
            result = correct(job)
            job.result_path.parent.mkdir(parents=True, exist_ok=True)
            job.result_path.write_text(json.dumps(asdict(result)) + "\n")
        result = Corrected(**json.loads(job.result_path.read_text()))
        first, last = result.evaluations[0], result.evaluations[-1]
        print(
            f"{result.task}, {result.condition}, seed {seed}: "
            f"{first['success']:.0f} % before, {last['success']:.0f} % with {last['kept']} corrected attempts "
            f"and {result.updates} updates, {result.control['success']:.0f} % with the updates alone",
            flush=True,
        )


if __name__ == "__main__":
    main()
