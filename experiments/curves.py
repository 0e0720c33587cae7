"""How far hearing carries: success over the number of demonstrations, over noise, over unknown materials, and in other rooms.

    python -m experiments.curves demonstrations --task=OccludedGrasp-v1 --seeds 1 2 3 4 5 --jobs=2
    python -m experiments.curves noise
    python -m experiments.curves materials
    python -m experiments.curves rooms

The last three take the full policies that `experiments.ablations` trained, as they are: those of the preset `cpu`, which
mixes noise into the sound, and never heard another material, a voice, a clatter or another microphone. Results that are there
are kept.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from experiments.ablations import STUDY
from experiments.protocol import (
    N_DEMONSTRATIONS,
    RESULTS,
    RUNS,
    TRAINING_SEEDS,
    Result,
    command_line,
    load,
    record,
    run,
    save,
    shown,
)
from experiments.training import Job, evaluate, side_by_side
from gym_playbyear.materials import CUBE_MATERIALS

N_DEMONSTRATIONS_TRIED = (3, 5, 10, 20, 50, 100)
ROOM_SEED = 7
KINDS, LEVELS = ("speech_like", "clatter"), ("1", "8")
NOISE_LEVELS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # factors on the noise's amplitude: silence, then 6 dB each


def over_demonstrations(task: str, tried: Sequence[int], seeds: Sequence[int], n_jobs: int, threads: int) -> None:
    """Full policies of all training seeds, deaf ones of those in `TRAINING_SEEDS`; as many updates whatever the number."""
    record(task, max(*tried, N_DEMONSTRATIONS))
    jobs = []
    for n in tried:
        study = (
            STUDY if n == N_DEMONSTRATIONS else "demonstrations"
        )  # what the ablations have trained is taken from there
        jobs += [Job(study, task, "full", seed, n, threads=threads) for seed in seeds]
        jobs += [Job(study, task, "deaf", seed, n, threads=threads) for seed in seeds if seed in TRAINING_SEEDS]
    for result in side_by_side(jobs, n_jobs):
        what = f"{result.task} {result.condition} {result.n_demonstrations} demonstrations"
        print(f"{what}: {result.summary}", flush=True)


def under_conditions(study: str, task: str, seeds: Sequence[int], conditions: Sequence[dict[str, str]]) -> None:
    """Evaluates the ablations' full policies in environments that differ, by these options, from those they were trained in."""
    for seed in seeds:
        job = Job(STUDY, task, "full", seed)
        trained = Result(**load(job.result_path))
        for condition in conditions:
            label = "-".join(
                f"{option}_{Path(value).stem if '/' in value else value}" for option, value in condition.items()
            )
            path = RESULTS / study / f"{job.name}-{label}.json"
            if not path.exists():
                commands = trained.commands[:1]
                options = [f"--env.{option}={value}" for option, value in condition.items()]
                attempts = evaluate(job, commands, *options, name=f"{study}-{label}")
                told = {option: shown([value]) for option, value in condition.items()}
                save(path, asdict(replace(trained, **asdict(attempts), environment=told, commands=commands)))
            print(f"{path.stem}: {Result(**load(path)).summary}", flush=True)


def rooms() -> list[dict[str, str]]:
    """Noise of kinds that no training draws from, and microphones of other frequency responses."""
    folder = RUNS / "room_noise"
    run(["python", "examples/room_noise.py", str(folder), f"--seed={ROOM_SEED}"], "room_noise", threads=1)
    noisy = [
        {"room_noise": str(folder / f"{kind}.wav"), "room_noise_level": level} for kind in KINDS for level in LEVELS
    ]
    return noisy + [
        {"microphone_response": response} | louder
        for response in ("phone", "dull", "boomy")
        for louder in ({}, {"noise_level": "8"})
    ]


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "jobs", "threads")
    parser.add_argument("curve", choices=("demonstrations", "noise", "materials", "rooms"))
    parser.add_argument(
        "--tried", nargs="+", type=int, default=N_DEMONSTRATIONS_TRIED, help="numbers of demonstrations"
    )
    options = parser.parse_args()
    if options.curve == "demonstrations":
        over_demonstrations(options.task, options.tried, options.seeds, options.jobs, options.threads)
        return
    conditions = {
        "noise": lambda: [{"noise_level": str(level)} for level in NOISE_LEVELS],
        "materials": lambda: [{"cube_material": material} for material in CUBE_MATERIALS],
        "rooms": rooms,
    }
    under_conditions(options.curve, options.task, options.seeds, conditions[options.curve]())


if __name__ == "__main__":
    main()
