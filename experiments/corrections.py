"""What corrections are worth: a middling policy, the same after HG-DAgger, and after as many updates without it.

    python -m experiments.corrections --task=OccludedGrasp-v0

1. A policy is trained on five demonstrations.
2. `playbyear-dagger` keeps 25 attempts in which the expert had to help, and learns from them as they come. These attempts may
   take longer than the task's own, so that the expert has the time to search again after a mistake.
3. The control goes on with the same demonstrations, for as many updates at the same largest rate.

All three are evaluated on the same 50 seeds: in the task's own time, and in that of the attempts, which suffices for a second
try. Resumes where it was interrupted.
"""

import json
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from experiments.protocol import (
    ATTEMPT_STEPS,
    CONDITIONS,
    EVALUATION_SEEDS,
    RESULTS,
    RUNS,
    command_line,
    library_versions,
    load,
    options_of,
    record,
    save,
    shown,
)
from experiments.training import Job, clocked, evaluate, train

STUDY = "corrections"
SEEDS = EVALUATION_SEEDS[:50]
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


def load_corrections(task: str) -> dict[tuple[str, int, int], list[Corrected]]:
    """The saved results of a task by their kind, those of one kind in the order of their training seeds."""
    results = [Corrected(**load(path)) for path in (RESULTS / STUDY).glob(f"{task}-*.json")]
    results.sort(key=lambda result: (result.condition != "full", result.kind, result.training_seed))
    return {kind: list(alike) for kind, alike in groupby(results, lambda result: result.kind)}


def correct(job: Job) -> Corrected:
    """Runs all three parts, or what is missing of them."""
    assert job.dataset is not None
    train_command, _ = train(job)
    folder = RUNS / "dagger" / job.name
    dagger = [
        "playbyear-dagger",
        f"--policy.path={job.checkpoint}",
        *options_of(job.dataset),
        *options_of(RUNS / "datasets" / f"corrections-{job.name}", "interventions"),
        "--env.type=playbyear",
        f"--env.task={job.task}",
        f"--env.episode_length={ATTEMPT_STEPS[job.task]}",
        f"--num_episodes={N_EPISODES}",
        f"--batch_size={BATCH_SIZE}",
        f"--seed={job.training_seed}",
        "--eval_every=0",
        "--skip_s=0",
        f"--save_every={EVERY}",
        f"--output_dir={folder}",
        "--resume=true",
    ]
    minutes = {"dagger": clocked(dagger, folder, job.threads)}
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    updates = max(line["step"] for line in lines)
    rounds = [line for line in lines if line["kind"] == "round" and "n_updates" in line]
    parts = {name for line in rounds for name in line if name.endswith("_s")}
    attempts = [line for line in lines if line["kind"] == "attempt"]

    commands = [train_command, shown(dagger)]
    policies = {0: (0, job.checkpoint)}
    for line in rounds:
        if line["round"] % EVERY == 0 or line is rounds[-1]:
            policies[line["round"]] = line["step"], folder / "checkpoints" / f"{line['step']:06}" / "pretrained_model"
    evaluations = []
    for kept, (step, checkpoint) in policies.items():
        rates = _evaluations(job, commands, str(kept), checkpoint, is_end=kept in (0, max(policies)))
        evaluations.append({"kept": kept, "updates": step, **rates})

    start = (f"--policy.path={job.checkpoint}", "--policy.push_to_hub=false", f"--batch_size={BATCH_SIZE}")
    variant = f"control-of-{job.steps}steps"
    control_job = replace(job, steps=updates, variant=variant, start=(*start, f"--save_freq={updates}"))
    control_command, minutes["control"] = train(control_job)
    commands.append(control_command)
    return Corrected(
        **job.learned,
        first_seed=SEEDS.start,
        n_episodes=len(SEEDS),
        evaluations=evaluations,
        attempts=[{key: line[key] for key in ("seed", "outcome", "intervention_share")} for line in attempts],
        updates=updates,
        control=_evaluations(control_job, commands, "control", control_job.checkpoint, is_end=True),
        minutes={name: round(spent, 1) for name, spent in minutes.items()},
        seconds={name: round(sum(line.get(name, 0.0) for line in rounds), 1) for name in sorted(parts)},
        commands=commands,
    )


def _evaluations(job: Job, commands: list[str], name: str, checkpoint: Path, is_end: bool) -> dict[str, float]:
    """Percentages of successes in the time of the attempts, and where a policy ends also in the task's own."""
    times: dict[str, tuple[str, ...]] = {"success": (f"--env.episode_length={ATTEMPT_STEPS[job.task]}",)}
    if is_end:
        times["in_task_time"] = ()
    rates = {}
    for key, options in times.items():
        told = evaluate(job, commands, *options, name=f"{STUDY}-{name}-{key}", checkpoint=checkpoint)
        rates[key] = 100 * sum(told.successes) / len(told.successes)
    return rates


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "threads")
    parser.set_defaults(seeds=[1])
    parser.add_argument("--n_demonstrations", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000, help="updates of the policy that is corrected")
    parser.add_argument("--condition", choices=CONDITIONS, default="full", help="senses of the policy")
    options = parser.parse_args()
    demonstrations = RUNS / "datasets" / f"{options.task}-{options.n_demonstrations}"
    record(options.task, options.n_demonstrations, demonstrations)
    for seed in options.seeds:
        number, steps = options.n_demonstrations, options.steps
        job = Job(
            *(STUDY, options.task, options.condition, seed, number, steps, options.threads, SEEDS),
            dataset=demonstrations,
        )
        if not job.result_path.exists():
            save(job.result_path, asdict(correct(job)))
        result = Corrected(**load(job.result_path))
        first, last = result.evaluations[0], result.evaluations[-1]
        print(
            f"{result.task}, {result.condition}, seed {seed}: "
            f"{first['success']:.0f} % before, {last['success']:.0f} % with {last['kept']} corrected attempts "
            f"and {result.updates} updates, {result.control['success']:.0f} % with the updates alone",
            flush=True,
        )


if __name__ == "__main__":
    main()
