"""The parts of a training run, made as lerobot-train makes them."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import OBS_STR
from lerobot.utils.utils import has_method

from lerobot_playbyear.compat import (
    eval_policy_all,
    get_step_checkpoint_dir,
    get_step_identifier,
    save_checkpoint,
    update_last_checkpoint,
)
from lerobot_playbyear.hub.push import push_checkpoint
from lerobot_playbyear.policy.batch_norm import mean_over_processes
from lerobot_playbyear.policy.sound_augmentation import SoundAugmentation
from lerobot_playbyear.training.checkpoints import load_training_state
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.windows import dataset_names

if TYPE_CHECKING:
    from accelerate import Accelerator


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

    def update(self, batch: Mapping[str, Any], grad_clip_norm: float) -> dict[str, Any]:
        """One update, as LeRobot's `update_policy` makes it, on a batch that the preprocessor has not seen yet.

        LeRobot's waits for the GPU twice, for two numbers of the log; here they are returned as tensors.

        Returns:
            Figures of this update: numbers, or tensors of one number.
        """
        start, policy, accelerator = time.perf_counter(), self.policy, self.accelerator
        policy.train()
        with accelerator.autocast():
            loss, figures = policy.forward(self.preprocessor(dict(batch)))
        accelerator.backward(loss)
        if grad_clip_norm > 0:
            norm = accelerator.clip_grad_norm_(policy.parameters(), grad_clip_norm)
        else:
            norm = torch.nn.utils.clip_grad_norm_(policy.parameters(), float("inf"))
        self.optimizer.step()
        self.optimizer.zero_grad()
        if self.scheduler is not None:
            self.scheduler.step()
        unwrapped: Any = self._unwrapped()
        if has_method(unwrapped, "update"):  # a policy with buffers of its own
            unwrapped.update()
        self.step += 1
        figures = {
            **(figures or {}),
            "loss": mean_over_processes(loss.detach()),
            "grad_norm": norm,
            "lr": self.optimizer.param_groups[0]["lr"],
        }
        if accelerator.device.type == "cuda":
            figures["gpu_mem_gb"] = torch.cuda.max_memory_allocated() / 2**30
        return {**figures, "update_s": time.perf_counter() - start}

    @torch.no_grad()
    def loss(self, batch: Mapping[str, Any]) -> float:
        """The policy's loss on a batch, as it would be in a rollout: no augmentation, no dropout."""
        policy = self._unwrapped()
        policy.eval()
        with self.accelerator.autocast():
            loss, _ = policy.forward(self.preprocessor(dict(batch)))
        policy.train()
        return float(loss)

    def save(self, cfg: PlaybyearTrainConfig) -> Path:
        """Write a checkpoint where lerobot-train would, and return its folder."""
        folder = get_step_checkpoint_dir(Path(str(cfg.output_dir)), cfg.steps, self.step)
        self.write_checkpoint(folder, cfg)
        update_last_checkpoint(folder)
        if cfg.save_checkpoint_to_hub and cfg.policy and cfg.policy.repo_id:
            push_checkpoint(folder, cfg.policy.repo_id, cfg.policy.private)
        return folder

    def write_checkpoint(self, folder: Path, cfg: PlaybyearTrainConfig) -> None:
        """Write LeRobot's checkpoint into a folder."""
        save_checkpoint(
            self.accelerator,
            cfg,
            checkpoint_dir=folder,
            step=self.step,
            policy=self._unwrapped(),
            optimizer=self.optimizer,
            scheduler=self.scheduler,
            preprocessor=self.preprocessor,
            postprocessor=self.postprocessor,
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
                    policy=self._unwrapped(),
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

    def _unwrapped(self) -> PreTrainedPolicy:
        """The policy itself, of one process. The wrapped one waits for the others."""
        policy: PreTrainedPolicy = self.accelerator.unwrap_model(self.policy)
        return policy


def make_training_parts(
    cfg: PlaybyearTrainConfig,
    meta: LeRobotDatasetMetadata,
    keep_normalization: bool = False,
    accelerator: "Accelerator | None" = None,
) -> TrainingParts:
    """Make policy, processors, optimizer and schedule for a dataset; where the run is resumed, from its checkpoint.

    Args:
        cfg: The options of the run.
        meta: The dataset's metadata.
        keep_normalization: Whether a checkpoint's statistics stay as they are, those of sound included; otherwise the
            dataset's take their place.
        accelerator: Of `make_accelerator`; None makes one.

    Raises:
        ValueError: If the dataset does not suit the policy, before the policy is made.
    """
    policy_cfg = cfg.policy
    if policy_cfg is None:
        raise ValueError("No policy: give --policy.type=playbyear, --policy.path or --preset.")
    check_dataset_suits(policy_cfg, meta, cfg.rename_map)
    from lerobot_playbyear.training.acceleration import compile_networks, fuse, prefer_channels_last

    policy = make_policy(cfg=policy_cfg, ds_meta=meta, rename_map=cfg.rename_map)
    from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

    if keep_normalization and isinstance(policy, PlaybyearPolicy):
        policy.keep_normalization()
    if accelerator is None:
        from lerobot_playbyear.training.processes import (
            make_accelerator,
        )  # late: it takes a second, and the data may be wrong

        accelerator = make_accelerator(policy_cfg)
    stats = None if cfg.resume or keep_normalization else meta.stats
    preprocessor, postprocessor = _make_processors(cfg, policy, stats, accelerator.device)
    optimizer, scheduler = make_optimizer_and_scheduler(cfg, policy)
    step = 0
    if cfg.resume and cfg.checkpoint_path is not None:
        step = load_training_state(cfg.checkpoint_path, optimizer, scheduler)
    if accelerator.device.type == "cuda":
        policy.to(accelerator.device)  # before its weights and the optimizer's state are laid out anew
        prefer_channels_last(policy, optimizer)
        fuse(optimizer)
    if cfg.compile:
        compile_networks(policy)
    policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
    policy.train()
    return TrainingParts(accelerator, policy, optimizer, scheduler, preprocessor, postprocessor, step)


def read_recorded_noise(policy: torch.nn.Module) -> None:
    """Reads the folder of recorded noise that a policy learns with, if there is one, before any work is done.

    Raises:
        InputError: The folder cannot be used.
    """
    for module in policy.modules():
        if isinstance(module, SoundAugmentation):
            module.read_recordings()


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
