"""Does hearing make the difference? The full policy beside the deaf, the sightless and the memoryless one.

    python -m experiments.ablations --task=OccludedGrasp-v0 --jobs=2

Resumes: results that are there are kept, a training that was interrupted goes on.
"""

from experiments.protocol import (
    CONDITIONS,
    EVALUATION_SEEDS,
    N_DEMONSTRATIONS,
    RUNS,
    blind_path,
    command_line,
    load,
    record,
    run,
    save,
    wilson_interval,
)
from experiments.training import Job, side_by_side

STUDY = "ablations"


def blind_floor(task: str) -> None:
    """What scripts reach that know all that the camera shows and feel nothing, on the same seeds."""
    if blind_path(task).exists():
        return
    output, seeds = RUNS / f"{task}-blind.json", EVALUATION_SEEDS
    command = ["python", "-m", "gym_playbyear.baselines", "--task", task]
    command += ["--n_episodes", str(len(seeds)), "--seed", str(seeds.start), "--output", str(output)]
    run(command, f"blind-{task}", threads=1)
    save(blind_path(task), load(output)[0])


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "jobs", "threads", "steps")
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    options = parser.parse_args()

    record(options.task, N_DEMONSTRATIONS)
    jobs = [
        Job(STUDY, options.task, condition, seed, steps=options.steps, threads=options.threads)
        for seed in options.seeds
        for condition in options.conditions
    ]
    for result in side_by_side(jobs, options.jobs):
        low, high = wilson_interval(sum(result.successes), len(result.successes))
        print(
            f"{result.task} {result.condition} seed {result.training_seed}: {result.rate:.0%} "
            f"[{low:.0%}, {high:.0%}] after {result.minutes} min",
            flush=True,
        )
    blind_floor(options.task)


if __name__ == "__main__":
    main()
