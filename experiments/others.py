"""What LeRobot's own policies make of the same demonstrations: ACT and Diffusion, each deaf, and with the sound of the last
seconds as a picture.

    python -m experiments.others --task=OccludedGrasp-v1 --minutes=20

All get the same demonstrations and one processor core or as many as are asked for. A short training tells how many updates
fit into the minutes; those that they took are in the results, and differ by what else the machine does. LeRobot's networks
keep their ResNet-18; transformer and U-Net are small. Pictures are rendered with 48 pixels, to which the preset `cpu` shrinks
those of 84, and the sound's have as many: columns of 50 ms, where ours hears steps of 25. They are normalised by the
dataset's statistics, not ImageNet's; ACT begins as `experiments.act_start` says; Diffusion warms up for 50 updates instead of
500. Batches are LeRobot's own of 8, in float32: bfloat16, in which ours trains, was no faster for ACT. Nothing is augmented.
All other settings are in `SETTINGS`. Datasets hold no column that a policy does not look at: LeRobot would read it all the
same. Resumes: results that are there are kept, a training that was interrupted goes on. Diffusion needs `lerobot[diffusion]`.
"""

import re
import shutil
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_STR

from experiments.act_start import saved_start
from experiments.protocol import (
    EVALUATION_SEEDS,
    N_DEMONSTRATIONS,
    NEW_TASKS,
    RESULTS,
    RUNS,
    Result,
    command_line,
    dataset_root,
    load,
    options_of,
    record,
    run,
    save,
    shown,
    wilson_interval,
)
from experiments.training import Job, clocked, evaluate
from lerobot_playbyear.audio.sound_picture import read_pictures
from lerobot_playbyear.datasets.features import AUDIO_PREFIX

STUDY = "others"
CONDITIONS = ("picture", "deaf")
SEEDS = (1, 2, 3)

_ACT = (
    "type=act pretrained_backbone_weights=null dim_model=128 n_heads=4 dim_feedforward=512 n_encoder_layers=2 "
    "n_vae_encoder_layers=2 latent_dim=16 chunk_size=20 optimizer_lr=1e-4 optimizer_lr_backbone=1e-4"
)
_DIFFUSION = (
    "type=diffusion pretrained_backbone_weights=null use_group_norm=true horizon=16 down_dims=[64,128,256] "
    "noise_scheduler_type=DDIM num_inference_steps=10 scheduler_warmup_steps=50"
)
SETTINGS = {
    "act": f"{_ACT} n_action_steps=4",
    "act_ensemble": f"{_ACT} n_action_steps=1 temporal_ensemble_coeff=0.01",
    "diffusion": f"{_DIFFUSION} n_action_steps=4",
    "diffusion_long": f"{_DIFFUSION} n_action_steps=8",
}
"""Options of each policy, without `--policy.`."""

PIXELS = 48
"""Of every picture, of the sound as of the cameras."""

_IMAGE_SIZE = f"--env.image_size={PIXELS}"
_BATCH_SIZE = 8  # LeRobot's own
_TRIAL_STEPS, _TRIAL_LOG = 100, 50
_TIMES = re.compile(r"updt_s:([\d.]+) data_s:([\d.]+)")


@dataclass
class OtherResult(Result):
    """A result of one of LeRobot's policies.

    Attributes:
        ms_per_step: Of `select_action` in a rollout, on average: most steps take an action from a chunk [ms].
        budget_minutes: That its updates were planned to take; `minutes` is what they took.
        settings: Of the policy.
        twin_closings: How often the hand closed in each episode of the twin world (`others_twin`); empty: not tried.
    """

    ms_per_step: float = 0.0
    budget_minutes: float = 0.0
    settings: str = ""
    twin_closings: list[int] = field(default_factory=list)


def prepare(task: str) -> None:
    """Records the demonstrations and makes of them the datasets of all conditions."""
    original = dataset_root(f"{task}-{PIXELS}px")
    record(task, N_DEMONSTRATIONS, original, _IMAGE_SIZE)
    attached = original.with_name(f"{original.name}-attached")
    if not attached.exists():
        command = ["playbyear-attach-spectrogram", *options_of(original), *options_of(attached, "output")]
        run(command, f"attach-{original.name}", threads=1)
    for condition, source in (("picture", attached), ("deaf", original)):
        target = dataset_of(task, condition)
        if target.exists():
            continue
        unfinished = target.with_name(f"{target.name}.unfinished")
        shutil.rmtree(unfinished, ignore_errors=True)
        sound = [key for key in load(source / "meta/info.json")["features"] if key.startswith(AUDIO_PREFIX)]
        command = [
            "lerobot-edit-dataset",
            f"--repo_id=experiments/{source.name}",
            f"--root={source}",
            f"--new_repo_id=experiments/{target.name}",
            f"--new_root={unfinished}",
            "--operation.type=remove_feature",
            f"--operation.feature_names={sound}",
        ]
        run(command, f"without-sound-{target.name}", threads=1)
        unfinished.rename(target)
    assert read_pictures(dataset_of(task, "picture")) == read_pictures(attached)


def dataset_of(task: str, condition: str) -> Path:
    return dataset_root(f"{task}-{PIXELS}px-{condition}")


def environment_options(task: str, condition: str) -> list[str]:
    """What makes the environment give pictures and sound as the condition's dataset does."""
    sound = [f"--env.spectrogram={dataset_of(task, condition)}"] if condition == "picture" else []
    return [_IMAGE_SIZE, *sound]


def beginning(job: Job, settings: str, folder: Path) -> tuple[list[str], list[str]]:
    """The options of a policy that has learned nothing. For ACT it is a checkpoint, which is made.

    Returns:
        Options of `lerobot-train`, and the commands that come first.
    """
    kind, *options = settings.split()
    if kind != "type=act":
        return [f"--policy.{option}" for option in (kind, *options)], []
    start = folder.with_name(f"{folder.name}.start")
    command = saved_start(options, dataset_of(job.task, job.condition), start, job.training_seed)
    return [f"--policy.path={start}"], [command]


def training_command(job: Job, settings: str, folder: Path, *options: str) -> list[str]:
    dataset = dataset_of(job.task, job.condition)
    return [
        "lerobot-train",
        *beginning(job, settings, folder)[0],
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        *options_of(dataset),
        "--dataset.video_backend=pyav",
        "--dataset.use_imagenet_stats=false",
        f"--output_dir={folder}",
        f"--batch_size={_BATCH_SIZE}",
        "--num_workers=0",
        "--env_eval_freq=0",
        f"--seed={job.training_seed}",
        "--wandb.enable=false",
        *options,
    ]


def seconds_per_update(job: Job, setting: str) -> float:
    """Measured by a short training, once for a setting and condition."""
    name = f"{dataset_of(job.task, job.condition).name}-{setting}-{job.threads}threads"
    path = RUNS / STUDY / f"{name}.json"
    if not path.exists():
        folder, log = RUNS / STUDY / f"trial-{name}", RUNS / "logs" / f"trial-{name}.log"
        shutil.rmtree(folder, ignore_errors=True)
        log.unlink(missing_ok=True)
        counts = [f"--steps={_TRIAL_STEPS}", f"--log_freq={_TRIAL_LOG}", "--save_checkpoint=false"]
        run(training_command(job, SETTINGS[setting], folder, *counts), f"trial-{name}", job.threads)
        update, data = _TIMES.findall(log.read_text())[-1]  # the last ones: the first updates warm up
        save(path, float(update) + float(data))
    return float(load(path))


def train(job: Job, setting: str) -> tuple[list[str], float]:
    """Trains the policy, or goes on where it was interrupted. Returns the commands, and their minutes in all."""
    folder = RUNS / "train" / job.name
    counts = [f"--steps={job.steps}", "--log_freq=100", f"--save_freq={max(job.steps // 5, 1)}"]
    command = training_command(job, SETTINGS[setting], folder, *counts)
    todo = command
    if (folder / "checkpoints" / f"{job.steps:06}").exists():
        todo = []
    elif (job.checkpoint / "train_config.json").exists():
        todo = ["lerobot-train", "--resume=true", f"--config_path={job.checkpoint / 'train_config.json'}"]
    elif folder.exists():
        shutil.rmtree(folder)
    commands = [*beginning(job, SETTINGS[setting], folder)[1], shown(command)]
    return commands, clocked(todo, folder, job.threads)


@torch.inference_mode()
def ms_per_step(job: Job, n_steps: int = 60) -> float:
    """Of `select_action` and what LeRobot does before and after it, on one episode's observations."""
    torch.set_num_threads(job.threads)
    config = PreTrainedConfig.from_pretrained(job.checkpoint)
    policy = get_policy_class(config.type).from_pretrained(job.checkpoint).eval()
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(job.checkpoint))
    data = dataset_of(job.task, job.condition)
    dataset = LeRobotDataset(f"experiments/{data.name}", root=data, episodes=[0], video_backend="pyav")
    frames = [dataset[i % len(dataset)] for i in range(n_steps)]
    batches = [{key: value[None] for key, value in frame.items() if key.startswith(f"{OBS_STR}.")} for frame in frames]
    policy.reset()
    postprocessor(policy.select_action(preprocessor(batches[0])))  # warms up
    policy.reset()
    start = time.perf_counter()
    for batch in batches:
        postprocessor(policy.select_action(preprocessor(batch)))
    return 1000 * (time.perf_counter() - start) / n_steps


def train_and_evaluate(
    task: str, setting: str, condition: str, seed: int, minutes: float, threads: int, seeds: range = EVALUATION_SEEDS
) -> OtherResult:
    """Trains, evaluates on these seeds of the environment and saves the result; returns the saved one if there is one."""
    chosen_by = "" if seeds == EVALUATION_SEEDS else f"-{seeds.start}to{seeds.stop - 1}"
    path = RESULTS / STUDY / f"{task}-{condition}-{setting}-{minutes:g}min-seed{seed}{chosen_by}.json"
    if path.exists():
        return OtherResult(**load(path))
    prepare(task)
    variant = f"{setting}-{minutes:g}min"
    job = Job(STUDY, task, condition, seed, threads=threads, variant=variant, evaluation_seeds=seeds)
    job = replace(job, steps=max(round(60 * minutes / seconds_per_update(job, setting)), 1))
    commands, spent = train(job, setting)
    attempts = evaluate(job, commands, *environment_options(task, condition), name=f"{STUDY}{chosen_by}")
    result = OtherResult(
        **job.learned,
        first_seed=job.evaluation_seeds.start,
        **asdict(attempts),
        minutes=round(spent, 1),
        threads=threads,
        commands=commands,
        ms_per_step=round(ms_per_step(job), 2),
        budget_minutes=minutes,
        settings=SETTINGS[setting],
    )
    save(path, asdict(result))
    return result


def show(results: Iterable[tuple[str, OtherResult]]) -> None:
    """Prints each result when it is there."""
    for setting, result in results:
        low, high = wilson_interval(sum(result.successes), len(result.successes))
        print(
            f"{result.task} {setting} {result.condition} seed {result.training_seed}: {result.rate:.0%} "
            f"[{low:.0%}, {high:.0%}] after {result.minutes} min, {result.steps} updates; {result.ms_per_step} ms per step",
            flush=True,
        )


def main() -> None:
    parser = command_line(__doc__, "task", "threads")
    parser.set_defaults(task=NEW_TASKS[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS[:1], help="of the policies' training")
    parser.add_argument("--minutes", type=float, default=20.0, help="of training, on an idle machine")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=["act", "diffusion"])
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=CONDITIONS)
    parser.add_argument(
        "--first_seed", type=int, default=EVALUATION_SEEDS.start, help="another where settings are chosen"
    )
    parser.add_argument("--n_episodes", type=int, default=len(EVALUATION_SEEDS))
    options = parser.parse_args()
    environment_seeds = range(options.first_seed, options.first_seed + options.n_episodes)
    show(
        (
            setting,
            train_and_evaluate(
                options.task, setting, condition, seed, options.minutes, options.threads, environment_seeds
            ),
        )
        for seed in options.seeds
        for setting in options.settings
        for condition in options.conditions
    )


if __name__ == "__main__":
    main()
