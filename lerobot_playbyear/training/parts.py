"""The parts of a training run, made as lerobot-train makes them, and the batches an `EpisodeStore` gives them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata, resolve_delta_timestamps
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.logging_utils import MetricsTracker
from torch import Tensor

from lerobot_playbyear.compat import (
    eval_policy_all,
    get_step_checkpoint_dir,
    get_step_identifier,
    load_training_state,
    save_checkpoint,
    update_last_checkpoint,
    update_policy,
)
from lerobot_playbyear.datasets import EpisodeStore, audio_keys
from lerobot_playbyear.hub.policies import push_checkpoint
from lerobot_playbyear.hub.pushing import push_meanwhile
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.config import PlaybyearTrainConfig

if TYPE_CHECKING:
    from accelerate import Accelerator

_DTYPES = {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}


def make_accelerator(policy: PreTrainedConfig) -> "Accelerator":
    """The Accelerator that lerobot-train makes for a policy: its device and precision, one process.

    Raises:
        ValueError: If several processes were launched.
    """
    from accelerate import Accelerator  # late, like the policy below: both take a second, and a dataset may be wrong

    mixed_precision = _DTYPES.get(getattr(policy, "dtype", ""))
    if not hasattr(policy, "dtype") and policy.use_amp:
        dtype = torch.get_autocast_dtype(torch.device(str(policy.device)).type)
        mixed_precision = {torch.bfloat16: "bf16", torch.float16: "fp16"}[dtype]
    accelerator = Accelerator(
        step_scheduler_with_optimizer=False, mixed_precision=mixed_precision, cpu=policy.device == "cpu"
    )
    if accelerator.num_processes > 1:
        raise ValueError("playbyear-train runs in one process; use lerobot-train for several GPUs.")
    return accelerator


class PolicyWindows:
    """Cuts the batches a policy trains on out of stores.

    The policy `playbyear` gets its observations only as far back as each is looked at, as bytes and 16-bit sound;
    other policies get exactly what LeRobot's data loader would give them.

    Args:
        policy: The policy's configuration, complete with its features.
        meta: The dataset's metadata.
        rename_map: The dataset's names of observations, with what the policy calls them.

    Attributes:
        n_windows: Windows per item that lie in a run of frames, K.
        action_deltas: Where the actions of an item lie, in frames from its last or, of a chunk, its first one; empty for a
            policy that learns single actions.
    """

    def __init__(
        self, policy: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str] | None = None
    ) -> None:
        self._as_lerobot = not isinstance(policy, PlaybyearConfig)
        if isinstance(policy, PlaybyearConfig):
            names = dataset_names(policy, rename_map)
            self._deltas = {names[key]: list(range(1 - n, 1)) for key, n in _history(policy).items()}
            self._deltas[ACTION] = list(policy.action_delta_indices)
        else:
            timestamps = resolve_delta_timestamps(policy, meta) or {}
            self._deltas = {key: [round(t * meta.fps) for t in times] for key, times in timestamps.items()}
        self.n_windows: int = getattr(policy, "n_supervised_steps", 1)
        self.action_deltas: list[int] = self._deltas.get(ACTION, [])

    @property
    def keys(self) -> list[str] | None:
        """The features that a store has to hold; None means all that it can."""
        return None if self._as_lerobot else list(self._deltas)

    def batch(self, store: EpisodeStore, last_frames: Tensor) -> dict[str, Any]:
        """The training items whose last frames are `last_frames` (B,), on the store's device."""
        return store.windows(last_frames, self._deltas, as_lerobot=self._as_lerobot)


def dataset_names(policy: PreTrainedConfig, rename_map: Mapping[str, str] | None = None) -> dict[str, str]:
    """What the dataset calls each observation of the policy."""
    original = {renamed: key for key, renamed in (rename_map or {}).items()}
    return {key: original.get(key, key) for key in policy.input_features or {}}


def _history(policy: PlaybyearConfig) -> dict[str, int]:
    """How many frames of each observation a training item holds."""
    return {
        **dict.fromkeys(policy.camera_keys if policy.use_vision else [], policy.n_image_frames),
        **dict.fromkeys(audio_keys(policy.input_features or {}) if policy.use_audio else [], policy.n_audio_frames),
        **dict.fromkeys(policy.low_dimensional_keys, policy.n_run_frames),
    }


@dataclass
class TrainingParts:
    """Everything that learns, and everything between it and the data.

    Attributes:
        accelerator: Device and precision.
        policy: The policy.
        optimizer: Its optimizer.
        scheduler: Of the learning rate; None means constant.
        preprocessor: From batches to what the policy takes.
        postprocessor: From what the policy returns to actions.
        step: Updates done.
    """

    accelerator: "Accelerator"
    policy: PreTrainedPolicy
    optimizer: torch.optim.Optimizer
    scheduler: Any
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline
    step: int = 0

    def update(self, batch: Mapping[str, Any], metrics: MetricsTracker, grad_clip_norm: float) -> MetricsTracker:
        """One update through LeRobot's `update_policy`, on a batch that the preprocessor has not seen yet."""
        metrics, _ = update_policy(
            metrics,
            self.policy,
            self.preprocessor(dict(batch)),
            self.optimizer,
            grad_clip_norm,
            accelerator=self.accelerator,
            lr_scheduler=self.scheduler,
        )
        self.step += 1
        return metrics

    @torch.no_grad()
    def loss(self, batch: Mapping[str, Any]) -> float:
        """The policy's loss on a batch, as it would be in a rollout: no augmentation, no dropout."""
        self.policy.eval()
        with self.accelerator.autocast():
            loss, _ = self.policy.forward(self.preprocessor(dict(batch)))
        self.policy.train()
        return float(loss)

    def save(self, cfg: PlaybyearTrainConfig) -> Path:
        """Write a checkpoint where lerobot-train would, and return its folder."""
        folder = get_step_checkpoint_dir(Path(str(cfg.output_dir)), cfg.steps, self.step)
        self.write_checkpoint(folder, cfg)
        update_last_checkpoint(folder)
        if cfg.save_checkpoint_to_hub and cfg.policy and cfg.policy.repo_id:
            push_meanwhile(partial(push_checkpoint, folder, cfg.policy.repo_id, cfg.policy.private), folder)
        return folder

    def write_checkpoint(self, folder: Path, cfg: PlaybyearTrainConfig) -> None:
        """Write LeRobot's checkpoint into a folder."""
        save_checkpoint(
            checkpoint_dir=folder,
            step=self.step,
            cfg=cfg,
            policy=self.accelerator.unwrap_model(self.policy),
            optimizer=self.optimizer,
            scheduler=self.scheduler,
            preprocessor=self.preprocessor,
            postprocessor=self.postprocessor,
            num_processes=1,
            batch_size=cfg.batch_size,
        )

    def evaluate(self, cfg: PlaybyearTrainConfig, n_videos: int = 4) -> dict[str, Any]:
        """Roll the policy out in the run's environment through LeRobot's `eval_policy_all`, and return its report."""
        if cfg.env is None:
            raise ValueError("An evaluation needs an environment: give --env.type and --env.task.")
        env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_cfg=cfg.env, policy_cfg=cfg.policy)
        envs = make_env(cfg.env, n_envs=cfg.eval.batch_size, use_async_envs=cfg.eval.use_async_envs)
        try:
            with torch.no_grad(), self.accelerator.autocast():
                return eval_policy_all(
                    envs=envs,
                    policy=self.accelerator.unwrap_model(self.policy),
                    env_preprocessor=env_preprocessor,
                    env_postprocessor=env_postprocessor,
                    preprocessor=self.preprocessor,
                    postprocessor=self.postprocessor,
                    n_episodes=cfg.eval.n_episodes,
                    videos_dir=Path(str(cfg.output_dir))
                    / "eval"
                    / f"videos_step_{get_step_identifier(self.step, cfg.steps)}",
                    max_episodes_rendered=n_videos,
                    start_seed=cfg.seed,
                    max_parallel_tasks=cfg.env.max_parallel_tasks,
                )
        finally:
            close_envs(envs)
            self.policy.train()


def make_training_parts(
    cfg: PlaybyearTrainConfig, meta: LeRobotDatasetMetadata, keep_normalization: bool = False
) -> TrainingParts:
    """Make policy, processors, optimizer and schedule for a dataset; where the run is resumed, from its checkpoint.

    Args:
        cfg: The options of the run.
        meta: The dataset's metadata.
        keep_normalization: Whether a checkpoint's statistics stay as they are, those of sound included; otherwise the
            dataset's take their place.

    Raises:
        ValueError: If the dataset does not suit the policy, before the policy is made.
    """
    policy_cfg = cfg.policy
    if policy_cfg is None:
        raise ValueError("No policy: give --policy.type=playbyear, --policy.path or --preset.")
    check_dataset_suits(policy_cfg, meta, cfg.rename_map)
    accelerator = make_accelerator(policy_cfg)
    policy = make_policy(cfg=policy_cfg, ds_meta=meta, rename_map=cfg.rename_map)
    from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

    if keep_normalization and isinstance(policy, PlaybyearPolicy):
        policy.keep_normalization()
    stats = None if cfg.resume or keep_normalization else meta.stats
    preprocessor, postprocessor = _make_processors(cfg, policy, stats, accelerator.device)
    optimizer, scheduler = make_optimizer_and_scheduler(cfg, policy)
    step = 0
    if cfg.resume and cfg.checkpoint_path is not None:
        step, optimizer, scheduler = load_training_state(cfg.checkpoint_path, optimizer, scheduler)
    policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
    policy.train()
    return TrainingParts(accelerator, policy, optimizer, scheduler, preprocessor, postprocessor, step)


def check_dataset_suits(
    policy: PreTrainedConfig, meta: LeRobotDatasetMetadata, rename_map: Mapping[str, str] | None = None
) -> None:
    """Refuse a dataset whose frame rate or features a policy was not made for.

    Raises:
        ValueError: Naming what was seen, what is wanted, and what to do.
    """
    fps = getattr(policy, "fps", None)
    if fps is not None and fps != meta.fps:
        raise ValueError(
            f"The dataset '{meta.repo_id}' has {meta.fps} frames per second, and the policy is configured for {fps}: "
            f"give --policy.fps={meta.fps}, or a dataset recorded at {fps}."
        )
    missing = [key for key in dataset_names(policy, rename_map).values() if key not in meta.features]
    if missing:
        seen = [key for key in meta.features if key.startswith(OBS_STR)]
        raise ValueError(
            f"The dataset '{meta.repo_id}' lacks {missing}, which the policy needs; its observations are {seen}. "
            "Use a dataset with these keys, or map its names with --rename_map."
        )


def _make_processors(
    cfg: PlaybyearTrainConfig, policy: PreTrainedPolicy, dataset_stats: Any, device: torch.device
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Pre- and postprocessor: new ones, or a checkpoint's with new statistics.

    Without statistics those of the checkpoint stay; so does a resumed run in lerobot-train.
    """
    config = policy.config
    stats = {} if dataset_stats is None else {"stats": dataset_stats}
    kwargs: dict[str, Any] = {} if dataset_stats is None else {"dataset_stats": dataset_stats}
    if config.pretrained_path:
        features = {**config.input_features, **config.output_features}
        norm_map = config.normalization_mapping
        kwargs["preprocessor_overrides"] = {
            "device_processor": {"device": device.type},
            "normalizer_processor": {"features": features, "norm_map": norm_map, **stats},
            "rename_observations_processor": {"rename_map": cfg.rename_map},
        }
        kwargs["postprocessor_overrides"] = {
            "unnormalizer_processor": {"features": config.output_features, "norm_map": norm_map, **stats}
        }
    return make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=config.pretrained_path,
        pretrained_revision=getattr(config, "pretrained_revision", None),
        **kwargs,
    )
