"""Where does the spread between training seeds come from, and what narrows it? One change at a time, over several seeds.

    python -m experiments.lottery --task=OccludedGrasp-v1 --jobs=2
    python -m experiments.lottery --task=OccludedGrasp-v1 --variants half_the_rate weight_decay

The episodes are of seeds on which choices are made, not of those that are reported elsewhere. Resumes.
"""

from collections.abc import Sequence
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
)
from experiments.training import Job, side_by_side

STUDY = "lottery"
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
    "weight_decay": ("--policy.optimizer_weight_decay=1e-4",),
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
    "hop_35ms": ("--policy.hop_s=0.035",),
    "quieter_noise": ("--policy.audio_noise_db=18",),
    "recorded_noise": ("--policy.audio_noise_db=24", f"--policy.audio_noise_files={NOISE}"),
    "no_noise": ("--policy.audio_noise_db=null",),
    "no_onset": ("--policy.auxiliary_onset=0",),
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
    "pixels_84": ("--policy.image_size=84",),
}
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
    options = options_of_variant(variant)
    return Job(STUDY, task, "full", seed, evaluation_seeds=CHOICE_SEEDS, options=options, steps=steps, variant=variant)


def main() -> None:
    parser = command_line(__doc__, "task", "jobs", "steps")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["preset"])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the trainings")
    options = parser.parse_args()
    record(options.task, N_DEMONSTRATIONS)
    jobs = [
        job_of(options.task, variant, seed, options.steps) for seed in options.seeds for variant in options.variants
    ]
    for job, result in zip(jobs, side_by_side(jobs, options.jobs), strict=True):
        print(f"{job.name}: {result.summary}, {result.minutes} min", flush=True)
    for variant in VARIANTS:
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
