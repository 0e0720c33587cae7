"""How far hearing carries: success over the number of demonstrations, over noise, and over unknown materials.

    python -m experiments.curves demonstrations --jobs=2
    python -m experiments.curves noise
    python -m experiments.curves materials

The last two take the full policies that `experiments.ablations` trained, as they are: those of the
preset `cpu`, which mixes noise into the sound, and never heard another material. Results that are there are kept.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace

from experiments.ablations import STUDY
from experiments.protocol import (
    N_DEMONSTRATIONS,
    RESULTS,
    TRAINING_SEEDS,
    Result,
    command_line,
    load,
    record,
    save,
)
from experiments.training import Job, evaluate, side_by_side
from gym_playbyear.materials import CUBE_MATERIALS

N_DEMONSTRATIONS_TRIED = (10, 20, 50, 100)
NOISE_LEVELS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # factors on the noise's amplitude: 6 dB each


def over_demonstrations(task: str, n_jobs: int, threads: int) -> None:
    """Full and deaf, one training seed each; as many updates whatever the number of demonstrations."""
    record(task, max(N_DEMONSTRATIONS_TRIED))
    jobs = []
    for n in N_DEMONSTRATIONS_TRIED:
        study = (
            STUDY if n == N_DEMONSTRATIONS else "demonstrations"
        )  # what the ablations have trained is taken from there
        jobs += [Job(study, task, condition, TRAINING_SEEDS[0], n, threads=threads) for condition in ("full", "deaf")]
    for result in side_by_side(jobs, n_jobs):
        what = f"{result.task} {result.condition} {result.n_demonstrations} demonstrations"
        print(f"{what}: {result.rate:.0%}", flush=True)


def under_conditions(study: str, task: str, seeds: Sequence[int], option: str, values: Sequence[str]) -> None:
    """Evaluates the ablations' full policies in environments that differ from those they were trained in."""
    for seed in seeds:
        job = Job(STUDY, task, "full", seed)
        trained = Result(**load(job.result_path))
        for value in values:
            name = f"{job.name}-{option}_{value}"
            path = RESULTS / study / f"{name}.json"
            if not path.exists():
                commands = trained.commands[:1]
                successes = evaluate(job, commands, f"--env.{option}={value}", name=f"{study}-{value}")
                result = replace(trained, successes=successes, environment={option: value}, commands=commands)
                save(path, asdict(result))
            print(f"{name}: {Result(**load(path)).rate:.0%}", flush=True)


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "jobs", "threads")
    parser.add_argument("curve", choices=("demonstrations", "noise", "materials"))
    options = parser.parse_args()
    if options.curve == "demonstrations":
        over_demonstrations(options.task, options.jobs, options.threads)
    elif options.curve == "noise":
        under_conditions("noise", options.task, options.seeds, "noise_level", [str(level) for level in NOISE_LEVELS])
    else:
        under_conditions("materials", options.task, options.seeds, "cube_material", list(CUBE_MATERIALS))


if __name__ == "__main__":
    main()
