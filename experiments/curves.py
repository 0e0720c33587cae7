"""How far hearing carries: success over the number of demonstrations, over noise, and over unknown materials.

    python -m experiments.curves demonstrations --jobs=2
    python -m experiments.curves noise
    python -m experiments.curves materials

The last two take the full policies that `experiments.ablations` trained, as they are: those of the
preset `cpu`, which mixes noise into the sound, and never heard another material. Results that are there are kept.
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from experiments.ablations import STUDY
from experiments.protocol import N_DEMONSTRATIONS, RESULTS, STEPS, TASKS, TRAINING_SEEDS, Result, record
from experiments.training import Job, evaluate, train_and_evaluate
from gym_playbyear.materials import CUBE_MATERIALS

N_DEMONSTRATIONS_TRIED = (10, 20, 50, 100)
NOISE_LEVELS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # factors on the noise's amplitude: 6 dB each


def over_demonstrations(task: str, jobs: int, threads: int) -> None:
    """Full and deaf, one training seed each; as many updates whatever the number of demonstrations."""
    record(task, max(N_DEMONSTRATIONS_TRIED))
    wanted = [
        # What the ablations have trained already is taken from there.
        Job(
            STUDY if n == N_DEMONSTRATIONS else "demonstrations",
            task,
            condition,
            TRAINING_SEEDS[0],
            n,
            STEPS[task],
            threads,
        )
        for n in N_DEMONSTRATIONS_TRIED
        for condition in ("full", "deaf")
    ]
    with ThreadPoolExecutor(jobs) as pool:
        for result in pool.map(train_and_evaluate, wanted):
            print(
                f"{result.task} {result.condition} {result.n_demonstrations} demonstrations: {result.rate:.0%}",
                flush=True,
            )


def under_conditions(study: str, task: str, seeds: Sequence[int], options: Sequence[dict[str, str]]) -> None:
    """Evaluates the ablations' full policies in environments that differ from those they were trained in."""
    for seed in seeds:
        job = Job(STUDY, task, "full", seed, N_DEMONSTRATIONS, STEPS[task])
        trained = Result.load(job.result_path)
        for environment in options:
            name = "-".join([job.name, *(f"{key}_{value}" for key, value in environment.items())])
            path = RESULTS / study / f"{name}.json"
            if not path.exists():
                commands = trained.commands[:1]
                arguments = [f"--env.{key}={value}" for key, value in environment.items()]
                successes = evaluate(job, commands, *arguments, name="-".join([study, *environment.values()]))
                replace(trained, successes=successes, environment=environment, commands=commands).save(path)
            print(f"{name}: {Result.load(path).rate:.0%}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("curve", choices=("demonstrations", "noise", "materials"))
    parser.add_argument("--task", choices=TASKS, default=TASKS[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=TRAINING_SEEDS, help="of the policies' training")
    parser.add_argument("--jobs", type=int, default=1, help="policies that are trained side by side")
    parser.add_argument("--threads", type=int, default=1, help="per policy")
    options = parser.parse_args()
    if options.curve == "demonstrations":
        over_demonstrations(options.task, options.jobs, options.threads)
    elif options.curve == "noise":
        levels = [{"noise_level": str(level)} for level in NOISE_LEVELS]
        under_conditions("noise", options.task, options.seeds, levels)
    else:
        materials = [{"cube_material": material} for material in CUBE_MATERIALS]
        under_conditions("materials", options.task, options.seeds, materials)


if __name__ == "__main__":
    main()
