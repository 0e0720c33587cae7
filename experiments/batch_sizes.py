"""How many runs per update, and how long: the same number of supervised windows in batches of several shapes, by minutes.

    python -m experiments.batch_sizes --jobs=2

Every row supervises 192,000 windows, a third of preset `cpu`'s: many small updates, or few large ones as a GPU likes them. The
episodes are of seeds on which choices are made, not of those that are reported elsewhere.
"""

import numpy as np

from experiments.protocol import N_DEMONSTRATIONS, command_line, record
from experiments.training import Job, side_by_side

STUDY = "batch_sizes"
N_WINDOWS = 192_000
SHAPES = ("12x16", "64x16", "64x32")  # runs per update x windows per run
SEEDS = (1, 2, 3, 4, 5)
CHOICE_SEEDS = range(50000, 50100)


def job_of(task: str, shape: str, seed: int, rate: float) -> Job:
    """One training.

    Args:
        shape: Such as `64x16`.
        rate: The learning rate.
    """
    runs, length = map(int, shape.split("x"))
    options = [f"--policy.n_supervised_steps={length}", f"--batch_size={runs}", f"--policy.optimizer_lr={rate}"]
    return Job(
        STUDY,
        task,
        "full",
        seed,
        steps=round(N_WINDOWS / (runs * length)),
        evaluation_seeds=CHOICE_SEEDS,
        options=tuple(options),
        variant=f"{shape}-lr{rate:g}",
    )


def main() -> None:
    parser = command_line(__doc__, "task", "jobs")
    parser.add_argument("--shapes", nargs="+", default=SHAPES, help="runs per update x windows per run")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the trainings")
    parser.add_argument("--rate", type=float, default=1e-3, help="the learning rate")
    options = parser.parse_args()
    record(options.task, N_DEMONSTRATIONS)
    jobs = [job_of(options.task, shape, seed, options.rate) for seed in options.seeds for shape in options.shapes]
    rates: dict[str, list[float]] = {}
    for job, result in zip(jobs, side_by_side(jobs, options.jobs), strict=True):
        rates.setdefault(job.variant, []).append(result.rate)
        print(f"{job.name}: {result.rate:.0%}, {result.minutes} min", flush=True)
    for variant, measured in rates.items():
        print(f"{variant}: mean {np.mean(measured):.0%}, worst {min(measured):.0%} of {len(measured)} trainings")


if __name__ == "__main__":
    main()
