"""How far hearing carries: success over the number of demonstrations, over noise, over unknown materials, and in other rooms.

    python -m experiments.curves demonstrations --task=OccludedGrasp-v1 --seeds 1 2 3 4 5 --jobs=2
    python -m experiments.curves noise --levels 0 1 8 16
    python -m experiments.curves noise --task=OccludedGrasp-v1 --trained quieter_noise --levels 0 1 8 16
    python -m experiments.curves rooms --task=OccludedGrasp-v1 --trained recorded_noise --steps=4000 --levels 8
    python -m experiments.curves materials
    python -m experiments.curves rooms --levels 8

Noise, materials and rooms take the full policies that `experiments.ablations` trained, as they are: those of the preset `cpu`,
which mixes noise into the sound, and never heard another material, a voice, a clatter or another microphone. `--trained` trains
others here: with quieter noise in their sound, with recordings of other kinds than those that are tried, or without
noise. Results that are there are kept.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from experiments.ablations import STUDY
from experiments.lottery import options_of_variant, recordings
from experiments.protocol import (
    N_DEMONSTRATIONS,
    RESULTS,
    RUNS,
    STEPS,
    TRAINING_SEEDS,
    Result,
    command_line,
    load,
    record,
    save,
    shown,
)
from experiments.training import Job, evaluate, side_by_side, train
from gym_playbyear.tasks.occluded import CUBE_MATERIALS

N_DEMONSTRATIONS_TRIED = (3, 5, 10, 20, 50, 100)
ROOM_SEED = 7
KINDS = ("speech_like", "clatter")
NOISE_LEVELS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # factors on the noise's amplitude: silence, then 6 dB each
ROOM_LEVELS = (1.0, 8.0)
TRAINED = ("quieter_noise", "recorded_noise", "no_noise")
"""Variants of `experiments.lottery` whose trainings it shares."""


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


def under_conditions(
    study: str,
    task: str,
    seeds: Sequence[int],
    conditions: Sequence[dict[str, str]],
    trained: str | None = None,
    steps: int = STEPS,
) -> None:
    """Evaluates full policies in environments that differ, by these options, from those they were trained in.

    Args:
        study: The results' folder.
        task, seeds: Of the trainings.
        conditions: The environments' options.
        trained: One of `TRAINED`; None for the policies of the ablations.
        steps: Updates of those that are trained here.
    """
    for seed in seeds:
        policy = trained_otherwise(task, seed, trained, steps) if trained else preset_policy(task, seed)
        for condition in conditions:
            print(evaluated_under(study, *policy, condition), flush=True)


def preset_policy(task: str, seed: int) -> tuple[Job, Result]:
    """One that the ablations trained."""
    job = Job(STUDY, task, "full", seed)
    return job, Result(**load(job.result_path))


def trained_otherwise(task: str, seed: int, variant: str, steps: int) -> tuple[Job, Result]:
    """One that is trained here; its result holds no episodes yet."""
    record(task, N_DEMONSTRATIONS)
    job = Job("curves", task, "full", seed, steps=steps, options=options_of_variant(variant), variant=variant)
    command, minutes = train(job)
    how = {"minutes": round(minutes, 1), "threads": job.threads, "commands": [command]}
    return job, Result(**job.learned, first_seed=job.evaluation_seeds.start, successes=[], **how)


def evaluated_under(study: str, job: Job, trained: Result, condition: dict[str, str]) -> str:
    """A line about a policy in one environment; the saved result if there is one."""
    label = "-".join(f"{option}_{Path(value).stem if '/' in value else value}" for option, value in condition.items())
    path = RESULTS / study / f"{job.name}-{label}.json"
    if not path.exists():
        commands = trained.commands[:1]
        options = [f"--env.{option}={value}" for option, value in condition.items()]
        attempts = evaluate(job, commands, *options, name=f"{study}-{label}")
        told = {option: shown([value]) for option, value in condition.items()}
        save(path, asdict(replace(trained, **asdict(attempts), environment=told, commands=commands)))
    return f"{path.stem}: {Result(**load(path)).summary}"


def rooms(levels: Sequence[float]) -> list[dict[str, str]]:
    """Noise of kinds that no training draws from, and microphones of other frequency responses.

    Args:
        levels: Of that noise, and of the background that these microphones hear.
    """
    folder = RUNS / "room_noise"
    recordings(folder, ROOM_SEED, KINDS)
    noisy = [
        {"room_noise": str(folder / f"{kind}.wav"), "room_noise_level": f"{level:g}"}
        for kind in KINDS
        for level in levels
    ]
    return noisy + [
        {"microphone_response": response} | ({} if level == 1 else {"noise_level": f"{level:g}"})
        for response in ("phone", "dull", "boomy")
        for level in levels
    ]


def main() -> None:
    parser = command_line(__doc__, "task", "seeds", "jobs", "threads", "steps")
    parser.add_argument("curve", choices=("demonstrations", "noise", "materials", "rooms"))
    parser.add_argument(
        "--tried", nargs="+", type=int, default=N_DEMONSTRATIONS_TRIED, help="numbers of demonstrations"
    )
    parser.add_argument("--levels", nargs="+", type=float, help="of noise, as factors on its amplitude")
    parser.add_argument("--trained", choices=TRAINED, help="with this, instead of the ablations' policies")
    options = parser.parse_args()
    if options.curve == "demonstrations":
        over_demonstrations(options.task, options.tried, options.seeds, options.jobs, options.threads)
        return
    noise = [{"noise_level": str(level)} for level in options.levels or NOISE_LEVELS]
    conditions = {
        "noise": lambda: noise,
        "materials": lambda: [{"cube_material": material} for material in CUBE_MATERIALS],
        "rooms": lambda: rooms(options.levels or ROOM_LEVELS),
    }
    study = "-".join(filter(None, [options.curve, options.trained]))
    under_conditions(study, options.task, options.seeds, conditions[options.curve](), options.trained, options.steps)


if __name__ == "__main__":
    main()
