"""Where does the spread between training seeds come from, and what narrows it? One change at a time, over several seeds.

    python -m experiments.lottery --task=OccludedGrasp-v1 --jobs=2
    python -m experiments.lottery --task=OccludedGrasp-v1 --variants colour weight_decay

Some trainings are evaluated again as other policies that they hold (`POLICIES`): that of `ema` by the weights of its last
update, which are the policy that `plain` would train, and by their mean over the last three checkpoints; that of `held_out`
by its last checkpoint instead of the one with the lowest held-out loss. So these are compared on the same trainings. The
episodes are of seeds on which choices are made, not of those that are reported elsewhere. Resumes.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from experiments.protocol import (
    N_DEMONSTRATIONS,
    RESULTS,
    RUNS,
    STEPS,
    Result,
    command_line,
    load,
    record,
    run,
    save,
    shown,
)
from experiments.training import Job, evaluate, side_by_side
from lerobot_playbyear.training.checkpoints import average_checkpoints, last_checkpoints

STUDY = "lottery"
PLAIN, EMA, HELD_OUT, LAST_THREE, NEWEST = "plain", "ema", "held_out", "last_three", "held_out_last"
_MORE_SHIFT = (
    "--policy.augmentation_crop=2",
    "--policy.augmentation_degrees=2",
    "--policy.augmentation_translate=0.02",
    "--policy.augmentation_scale=0.02",
)
_NO_SHIFT = (
    "--policy.augmentation_crop=0",
    "--policy.augmentation_degrees=0",
    "--policy.augmentation_translate=0",
    "--policy.augmentation_scale=0",
)
NOISE = RUNS / "training_noise"
"""Recordings that training mixes in, of other kinds than those that `experiments.curves` tries."""
NOISE_KINDS = ("hum", "music_like", "hammering", "typing", "tool")
NOISE_SEEDS = (101, 102, 103)
VARIANTS: dict[str, tuple[str, ...]] = {
    "preset": (),
    EMA: ("--policy.ema_decay=0.998",),
    "weight_decay": ("--policy.optimizer_weight_decay=1e-4",),
    "colour": ("--policy.audio_colour_db=4",),
    "twice_the_rate": ("--policy.optimizer_lr=2e-3",),
    "half_the_rate": ("--policy.optimizer_lr=5e-4",),
    "less_noise_on_the_arm": ("--policy.low_dimensional_noise=0.01",),
    "half_the_noise_on_the_arm": ("--policy.low_dimensional_noise=0.0075",),
    "twice_the_noise_on_the_arm": ("--policy.low_dimensional_noise=0.03",),
    "more_noise_on_the_arm": ("--policy.low_dimensional_noise=0.05",),
    "more_offset": ("--policy.low_dimensional_offset=0.15",),
    "more_shift": _MORE_SHIFT,
    "more_shift_and_offset": (*_MORE_SHIFT, "--policy.low_dimensional_offset=0.15"),
    "no_shift": _NO_SHIFT,
    "no_offset": ("--policy.low_dimensional_offset=0",),
    "no_displacement": ("--policy.memory_displacement_gain=0", "--policy.memory_readers=0"),
    "half_the_runs": ("--batch_size=6",),
    "twice_the_runs": ("--policy.n_supervised_steps=8", "--batch_size=24"),
    "shorter_memory": ("--policy.n_memory_steps=10",),
    HELD_OUT: ("--dataset.eval_split=0.1", "--save_best=true"),
    "dropout": ("--policy.fusion_dropout=0.1",),
    "attention": ("--policy.fusion=attention",),
    "hop_35ms": ("--policy.hop_s=0.035",),
    "log_mel": ("--policy.audio_features=log_mel",),
    "pcen": ("--policy.audio_features=pcen",),
    "quieter_noise": ("--policy.audio_noise_db=18",),
    "recorded_noise": ("--policy.audio_noise_db=24", f"--policy.audio_noise_files={NOISE}"),
    "no_noise": ("--policy.audio_noise_db=null",),
    "no_onset": ("--policy.auxiliary_onset=0",),
    "past_onsets": ("--policy.auxiliary_onset_s=0.75",),
    "action_range_1": ("--policy.action_range=1",),
    "no_envelope": ("--policy.audio_envelope_gain=0",),
    "no_readers": ("--policy.memory_readers=0",),
    "no_readers_no_envelope": ("--policy.memory_readers=0", "--policy.audio_envelope_gain=0"),
    "memory_26": ("--policy.n_memory_steps=26",),
    "fainter_envelope": ("--policy.audio_envelope_gain=0.3",),
    "longer_memory": ("--policy.n_memory_steps=30",),
    "no_balance": ("--policy.auxiliary_balance=0",),
    "more_balance": ("--policy.auxiliary_balance=0.3",),
    "no_way": ("--policy.auxiliary_way=0",),
    "less_way": ("--policy.auxiliary_way=0.1",),
    "more_way": ("--policy.auxiliary_way=1",),
    "next_sound": ("--policy.auxiliary_next_sound=0.01",),
    "inverse_dynamics": ("--policy.auxiliary_inverse_dynamics=0.3",),
    "action_chunk": ("--policy.auxiliary_chunk=0.5",),
    "pixels_84": ("--policy.image_size=84",),
}
POLICIES: dict[str, tuple[str, ...]] = {EMA: (PLAIN, LAST_THREE), HELD_OUT: (NEWEST,)}
"""By the variant that is trained: the other policies that its checkpoints hold."""
CHOICE_SEEDS = range(50000, 50100)
SEEDS = (1, 2, 3, 4, 5)


def options_of_variant(variant: str) -> tuple[str, ...]:
    """Its options of `playbyear-train`; what they name is made first."""
    if f"--policy.audio_noise_files={NOISE}" in VARIANTS[variant]:
        for seed in NOISE_SEEDS:
            recordings(NOISE / str(seed), seed, NOISE_KINDS)
    return VARIANTS[variant]


def recordings(folder: Path, seed: int, kinds: Sequence[str]) -> None:
    """Makes recordings of noise, always the same ones, unless they are there."""
    if folder.exists():
        return
    unfinished = folder.with_name(f"{folder.name}.unfinished")
    command = ["python", "examples/room_noise.py", str(unfinished), f"--seed={seed}", "--kinds", *kinds]
    run(command, f"{folder.parent.name}-{folder.name}", threads=1)
    unfinished.rename(folder)


def job_of(task: str, variant: str, seed: int, steps: int = STEPS) -> Job:
    """One training."""
    chosen = "best" if variant == HELD_OUT else "last"
    options = options_of_variant(variant)
    names = {"steps": steps, "variant": variant, "chosen": chosen}
    return Job(STUDY, task, "full", seed, evaluation_seeds=CHOICE_SEEDS, options=options, **names)


def evaluated_as(policy: str, job: Job, trained: Result) -> Result:
    """One of the `POLICIES` of a training; the saved result if there is one."""
    other = replace(job, variant=policy)
    if not other.result_path.exists():
        commands, checkpoint = trained.commands[:1], job.checkpoint
        if policy == LAST_THREE:
            checkpoint = average_of_last(job, 3, commands)
        elif policy == NEWEST:
            checkpoint = replace(job, chosen="last").checkpoint
        options = ["--policy.ema_decay=0"] if job.variant == EMA else []
        attempts = evaluate(job, commands, *options, name=f"{STUDY}-{policy}", checkpoint=checkpoint)
        save(other.result_path, asdict(replace(trained, **asdict(attempts), commands=commands)))
    return Result(**load(other.result_path))


def average_of_last(job: Job, n: int, commands: list[str]) -> Path:
    """The mean of a training's last n checkpoints; how it is made is appended to the commands."""
    run, output = RUNS / "train" / job.name, RUNS / "train" / f"{job.name}-last{n}"
    commands.append(shown([f"average_checkpoints(last_checkpoints({run}, {n}), {output})"]))
    return output if output.exists() else average_checkpoints(last_checkpoints(run, n), output)


def main() -> None:
    parser = command_line(__doc__, "task", "jobs", "steps")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=[EMA])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the trainings")
    options = parser.parse_args()
    record(options.task, N_DEMONSTRATIONS)
    jobs = [
        job_of(options.task, variant, seed, options.steps) for seed in options.seeds for variant in options.variants
    ]
    for job, result in zip(jobs, side_by_side(jobs, options.jobs), strict=True):
        print(f"{job.name}: {result.summary}, {result.minutes} min", flush=True)
        for policy in POLICIES.get(job.variant, ()):
            print(f"{job.name}, {policy}: {evaluated_as(policy, job, result).summary}", flush=True)
    for variant in (PLAIN, LAST_THREE, NEWEST, *VARIANTS):
        results = [
            Result(**load(path))
            for path in sorted((RESULTS / STUDY).glob(f"{options.task}-full-{variant}-*-{options.steps}steps-*.json"))
        ]
        if results:
            rates = [result.rate for result in results]
            spread = f"worst {min(rates):.0%}, spread {np.std(rates):.1%} of {len(rates)}"
            early = [result.early_rate for result in results if result.early_rate is not None]
            print(
                f"{variant}: mean {np.mean(rates):.0%}, {spread}{f', acted early {np.mean(early):.0%}' if early else ''}"
            )


if __name__ == "__main__":
    main()
