"""Does hearing make the difference? The full policy beside the deaf, the sightless and the memoryless one.

    python -m experiments.ablations --task=OccludedGrasp-v0 --jobs=2

Resumes: results that are there are kept, a training that was interrupted goes on.
"""

import argparse
import json
from concurrent.futures import ThreadPoolExecutor

from experiments.protocol import (
    CONDITIONS,
    EVALUATION_SEEDS,
    N_DEMONSTRATIONS,
    RESULTS,
    RUNS,
    STEPS,
    TASKS,
    TRAINING_SEEDS,
    record,
    run,
    tool,
    wilson_interval,
)
from experiments.training import Job, train_and_evaluate

STUDY = "ablations"


def blind_floor(task: str, seeds: range = EVALUATION_SEEDS) -> None:
    """What scripts reach that know all that the camera shows and feel nothing, on the same seeds."""
    path = RESULTS / STUDY / f"{task}-blind.json"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    output = RUNS / f"{task}-blind.json"
    command = [tool("python"), "-m", "gym_playbyear.baselines", "--task", task]
    command += ["--n_episodes", str(len(seeds)), "--seed", str(seeds.start), "--output", str(output)]
    run(command, RUNS / "logs" / f"blind-{task}.log", threads=1)
    path.write_text(json.dumps(json.loads(output.read_text())[0]) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, default=TASKS[0])
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--seeds", nargs="+", type=int, default=TRAINING_SEEDS, help="of training")
    parser.add_argument("--jobs", type=int, default=1, help="policies that are trained side by side")
    parser.add_argument("--threads", type=int, default=1, help="per policy")
    options = parser.parse_args()

    record(options.task, N_DEMONSTRATIONS)
    blind_floor(options.task)
    jobs = [
        Job(STUDY, options.task, condition, seed, N_DEMONSTRATIONS, STEPS[options.task], options.threads)
        for seed in options.seeds
        for condition in options.conditions
    ]
    with ThreadPoolExecutor(options.jobs) as pool:
        for result in pool.map(train_and_evaluate, jobs):
            low, high = wilson_interval(sum(result.successes), len(result.successes))
            print(
                f"{result.task} {result.condition} seed {result.training_seed}: {result.rate:.0%} "
                f"[{low:.0%}, {high:.0%}] after {result.minutes} min",
                flush=True,
            )


if __name__ == "__main__":
    main()
