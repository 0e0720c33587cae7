"""What `playbyear-dagger` can be told."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import DatasetConfig, EvalConfig, WandBConfig
from lerobot.envs import EnvConfig

from lerobot_playbyear.dagger import robot_gated  # noqa: F401  (registers --method.type=robot_gated)
from lerobot_playbyear.dagger.methods import HgDagger, Method
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes.experts import ExpertConfig, ScriptedExpertConfig
from lerobot_playbyear.training.config import PlaybyearTrainConfig, StoreConfig

CONFIG_NAME = "dagger_config.json"
"""File in the output folder with the options of the run."""

_LEAST = {"warmup_episodes": 1, "max_attempts": 1}  # of the other whole numbers: 0


@dataclass
class DaggerEvalConfig(EvalConfig):
    """LeRobot's options of an evaluation, with defaults that suit one that is repeated often."""

    batch_size: int = 10
    use_async_envs: bool = False


@dataclass
class DaggerConfig:
    """Options of `playbyear-dagger`.

    Attributes:
        dataset: The demonstrations that the policy was trained on. Half of each batch comes from them.
        interventions: The dataset of rollouts with corrections. It is created, or appended to.
        policy: The policy to improve, `--policy.path`. Its normalisation is kept. `--policy.push_to_hub` and `--policy.repo_id`
            work as in lerobot-train.
        env: The environment, as in lerobot-eval.
        expert: The source of corrections: `--expert.type=scripted` or another registered one.
        method: When the expert acts, and what is learned: `--method.type=hg_dagger` or another registered one.
        skip_s: Seconds ignored at the start of each correction. The policy's memory still holds its own last movements there,
            so it would mistake the expert's retreat for the next step of the task. Shorter corrections are left out, unless all
            are shorter. A correction that starts with the episode is used whole. None: the length of the policy's memory, or 0
            with `--method.type=redo`.
        new_weights: With `num_episodes=0`: start from newly initialised weights instead of the policy's. The normalisation is
            kept.
        num_episodes: Corrected rollouts to collect, including those before a resume. 0: collect none; no environment is needed,
            see `steps`.
        updates_per_episode: Updates after each collected rollout.
        warmup_episodes: Rollouts that the dataset holds before the first update.
        steps: With `num_episodes=0`: number of updates on the recorded corrections.
        batch_size: Sequences of windows per update, half of them from the demonstrations.
        learning_rate: Largest learning rate of each round (Adam). None: the policy's own (`optimizer_lr`). A smaller rate
            hardly changes a policy that has memorised its demonstrations.
        anneal: Decay the rate to 0 within each round (cosine), and its peak to a tenth over all rounds. Then the policy that
            acts next has settled, and the last one most of all. False: a constant rate.
        warmup_updates: Updates over which the rate rises at the start of the run.
        seed: Seed of training, and of the first evaluation episode, as in lerobot-train.
        episode_seed: Seed of the first rollout. Later rollouts count up and skip the evaluation's seeds.
        max_attempts: Rollouts in a row without a correction, after which the run ends. Rollouts in which no expert can act do
            not count.
        eval_every: Rounds between two evaluations. There is also one before the first round and one after the last. 0: none.
            Evaluated checkpoints are kept, and the last one.
        eval: Size of an evaluation, as in lerobot-eval.
        output_dir: Folder of checkpoints, metrics and options.
        resume: Continue the run in `output_dir`, or start it if there is none. Options that are not given keep their values.
        job_name: Name of the run in Weights & Biases.
        store: Where the datasets are kept, as in playbyear-train.
        rename_map: Maps the datasets' observation names to the policy's.
        wandb: Weights & Biases, as in lerobot-train.
    """

    dataset: DatasetPlace
    interventions: DatasetPlace
    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    expert: ExpertConfig = field(default_factory=ScriptedExpertConfig)
    method: Method = field(default_factory=HgDagger)
    skip_s: float | None = None
    new_weights: bool = False
    num_episodes: int = 25
    updates_per_episode: int = 100
    warmup_episodes: int = 5
    steps: int = 0
    batch_size: int = 24
    learning_rate: float | None = None
    anneal: bool = True
    warmup_updates: int = 50
    seed: int = 1000
    episode_seed: int = 10_000
    max_attempts: int = 50
    eval_every: int = 5
    eval: DaggerEvalConfig = field(default_factory=DaggerEvalConfig)
    output_dir: Path = Path("outputs/dagger")
    resume: bool = False
    job_name: str = "dagger"
    store: StoreConfig = field(default_factory=StoreConfig)
    rename_map: dict[str, str] = field(default_factory=dict)
    wandb: WandBConfig = field(default_factory=WandBConfig)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """For LeRobot's parser: the fields that take `.path`."""
        return ["policy"]

    @property
    def is_online(self) -> bool:
        """Whether attempts are collected."""
        return self.num_episodes > 0

    @property
    def eval_seeds(self) -> range:
        """Of all evaluation episodes, those included that only fill the last batch of environments."""
        n_batches = -(-self.eval.n_episodes // max(self.eval.batch_size, 1))  # LeRobot makes it 0 where there are none
        return range(self.seed, self.seed + n_batches * self.eval.batch_size)

    def check(self) -> None:
        """Raise a InputError if a number is out of its range or an option is missing."""
        if self.learning_rate is not None and not self.learning_rate > 0:
            raise InputError(f"--learning_rate={self.learning_rate} must be above 0.")
        for name, value in vars(self).items():
            if isinstance(value, int) and value < _LEAST.get(name, 0):
                raise InputError(f"--{name}={value}: give at least {_LEAST.get(name, 0)}.")
        if self.eval.n_episodes < (self.eval_every > 0):
            raise InputError(f"--eval.n_episodes={self.eval.n_episodes}: give at least 1, or --eval_every=0 for none.")
        if self.batch_size < 2 or self.batch_size % 2:
            raise InputError(f"--batch_size={self.batch_size} must be even: half of each batch are demonstrations.")
        if self.is_online and self.steps:
            raise InputError("--steps is for --num_episodes=0; with episodes give --updates_per_episode.")
        if not self.is_online and not self.steps:
            raise InputError("--num_episodes=0 collects nothing: give --steps, how many updates to make.")
        self.method.check()
        if not 0 <= (self.skip_s or 0) < math.inf:
            raise InputError(f"--skip_s={self.skip_s}: give 0 or more seconds.")
        if self.skip_s and not self.method.skips_beginnings:
            raise InputError(
                f"--skip_s={self.skip_s}: with --method.type={self.method.type} the expert chooses every frame, and no "
                "correction has a beginning; leave it out."
            )
        if self.new_weights and self.is_online:
            raise InputError(
                "--new_weights=true: a policy that knows nothing cannot be corrected. Collect attempts first, and then learn "
                "from all of them with --num_episodes=0 --steps=N --new_weights=true and another --output_dir."
            )
        if self.is_online and self.env is None:
            raise InputError(
                "No environment: give --env.type and --env.task, or --num_episodes=0 --steps=N to learn from recorded "
                "corrections alone."
            )

    def n_skipped(self, fps: float) -> int:
        """Frames at the beginning of every correction that are not learned from."""
        if not self.method.skips_beginnings:
            return 0
        if self.skip_s is None:
            n_remembered = int(getattr(self.policy, "memory_steps", 1))
            return n_remembered if n_remembered > 1 else 0
        return math.ceil(round(self.skip_s * fps, 6))

    def rate(self, step: int, number: int, n_updates: int, n_before: int = 0) -> float:
        """The learning rate of an update.

        Args:
            step: Updates of the run before it.
            number: Updates of the round before it.
            n_updates: Updates of the round.
            n_before: Attempts that the dataset held before the run.
        """
        rate = self.largest_rate * min(1.0, (step + 1) / max(self.warmup_updates, 1))
        if not self.anneal:
            return rate
        if not self.is_online:  # rounds are there to be saved; nobody acts in between
            number, n_updates = step, self.steps
        done = min(1.0, (step - number) / self.total_updates(n_before))
        return rate * (1 - 0.9 * done) * 0.5 * (1 + math.cos(math.pi * number / n_updates))

    @property
    def largest_rate(self) -> float:
        """What `learning_rate` says, or else the policy."""
        if self.learning_rate is not None:
            return self.learning_rate
        assert self.policy is not None
        return float(self.policy.get_optimizer_preset().lr)

    def total_updates(self, n_before: int = 0) -> int:
        """Updates of a run that keeps all attempts it is asked for, in a dataset that held `n_before`."""
        n_rounds = max(self.num_episodes - max(self.warmup_episodes - 1 - n_before, 0), 1)
        return self.steps or n_rounds * self.updates_per_episode

    def training(self) -> PlaybyearTrainConfig:
        """The same as options of playbyear-train, for what HG-DAgger shares with it."""
        shared = vars(self).keys() & {option.name for option in fields(PlaybyearTrainConfig)}  # they mean the same,
        shared -= {"dataset", "steps"}  # but for these
        assert self.policy is not None
        optimizer = self.policy.get_optimizer_preset()
        optimizer.lr = self.largest_rate
        return PlaybyearTrainConfig(
            dataset=DatasetConfig(self.dataset.repo_id, root=self.dataset.root),
            steps=self.total_updates(),
            num_workers=0,
            env_eval_freq=0,
            optimizer=optimizer,
            **{name: getattr(self, name) for name in shared},
        )

    def options(self) -> dict[str, Any]:
        """What is kept in `dagger_config.json`; the policy is kept in the checkpoints."""
        encoded: dict[str, Any] = draccus.encode(self)
        return {key: value for key, value in encoded.items() if key not in ("policy", "resume")}


def with_saved_options(args: Sequence[str]) -> list[str]:
    """The command line of a resumed run, with the options that its output folder holds underneath.

    Args:
        args: Command-line arguments; without `--resume` they are returned as they are.
    """
    args = list(args)
    is_resumed = (parser.parse_arg("resume", args) or "").lower() in ("true", "yes", "on")
    folder = Path(parser.parse_arg("output_dir", args) or DaggerConfig.output_dir)
    if is_resumed and parser.parse_arg("config_path", args) is None and (folder / CONFIG_NAME).is_file():
        return [f"--config_path={folder / CONFIG_NAME}", *args]
    return args
