"""Where does the spread between training seeds come from, and what narrows it? One change at a time, over several seeds.

    python -m experiments.lottery --task=OccludedGrasp-v1 --jobs=2
    python -m experiments.lottery --task=OccludedGrasp-v1 --variants colour weight_decay

The variant `ema` is evaluated twice, by the average of its weights and by those of the last update, which are the policy that
`plain` would train: so the two are compared on the same trainings. The episodes are of seeds on which choices are made, not of
those that are reported elsewhere. Resumes.
"""

from dataclasses import asdict, replace

import numpy as np

from experiments.protocol import N_DEMONSTRATIONS, RESULTS, Result, command_line, load, record, save
from experiments.training import Job, evaluate, side_by_side

STUDY = "lottery"
PLAIN, EMA = "plain", "ema"
VARIANTS: dict[str, tuple[str, ...]] = {
    EMA: ("--policy.ema_decay=0.998",),
    "weight_decay": ("--policy.optimizer_weight_decay=1e-4",),
    "colour": ("--policy.audio_colour_db=4",),
    "twice_the_rate": ("--policy.optimizer_lr=2e-3",),
    "half_the_rate": ("--policy.optimizer_lr=5e-4",),
    "more_noise_on_the_arm": ("--policy.low_dimensional_noise=0.06",),
    "twice_the_runs": ("--policy.n_supervised_steps=8", "--batch_size=24"),
    "longer_memory": ("--policy.n_memory_steps=20",),
}
CHOICE_SEEDS = range(50000, 50100)
SEEDS = (1, 2, 3, 4, 5)


def job_of(task: str, variant: str, seed: int) -> Job:
    """One training."""
    return Job(STUDY, task, "full", seed, evaluation_seeds=CHOICE_SEEDS, options=VARIANTS[variant], variant=variant)


def by_last_weights(job: Job, averaged: Result) -> Result:
    """The policy of an `ema` training as it would be without an average."""
    plain = replace(job, variant=PLAIN)
    if not plain.result_path.exists():
        commands = averaged.commands[:1]
        successes = evaluate(job, commands, "--policy.ema_decay=0", name=f"{STUDY}-last")
        save(plain.result_path, asdict(replace(averaged, successes=successes, commands=commands)))
    return Result(**load(plain.result_path))


def main() -> None:
    parser = command_line(__doc__, "task", "jobs")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=[EMA])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the trainings")
    options = parser.parse_args()
    record(options.task, N_DEMONSTRATIONS)
    jobs = [job_of(options.task, variant, seed) for seed in options.seeds for variant in options.variants]
    for job, result in zip(jobs, side_by_side(jobs, options.jobs), strict=True):
        print(f"{job.name}: {result.rate:.0%}, {result.minutes} min", flush=True)
        if job.variant == EMA:
            print(f"{job.name}, last weights: {by_last_weights(job, result).rate:.0%}", flush=True)
    for variant in (PLAIN, *VARIANTS):
        paths = sorted((RESULTS / STUDY).glob(f"{options.task}-full-{variant}-*.json"))
        rates = [Result(**load(path)).rate for path in paths]
        if rates:
            print(
                f"{variant}: mean {np.mean(rates):.0%}, worst {min(rates):.0%}, spread {np.std(rates):.1%} of {len(rates)}"
            )


if __name__ == "__main__":
    main()
