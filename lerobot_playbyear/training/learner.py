"""What learns, made as lerobot-train makes it: its updates, its checkpoints, and what it cannot learn."""

import ctypes
import logging
import math
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from accelerate.utils import InitProcessGroupKwargs
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.optim import load_optimizer_state, load_scheduler_state
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, PolicyProcessorPipeline, TransitionKey, create_transition
from lerobot.utils.constants import ACTION, LAST_CHECKPOINT_LINK, OBS_STR, TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.random_utils import load_rng_state
from torch import Tensor, nn
from torch.optim import Adam, Optimizer

from lerobot_playbyear.compat import eval_policy_all, get_step_checkpoint_dir, get_step_identifier, save_checkpoint
from lerobot_playbyear.datasets.checkpoint_steps import check_steps
from lerobot_playbyear.datasets.features import is_depth, number_names
from lerobot_playbyear.datasets.files import INFO_PATH, flush_all, new_folder, parse_json, replace_link
from lerobot_playbyear.datasets.remedies import without_feature
from lerobot_playbyear.hub.push import push_checkpoint
from lerobot_playbyear.policy.batch_norm import mean_over_processes
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.policy.networks import VisionEncoder
from lerobot_playbyear.policy.processor_playbyear import microphone_step
from lerobot_playbyear.training.batches import Renamed, dataset_names
from lerobot_playbyear.training.config import PlaybyearTrainConfig

_DTYPES = {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}
_PATIENCE = timedelta(days=7)  # others wait while one evaluates or decodes a dataset

_TOLERANCE = 0.01  # of the range of actions: what is learned a hundredth too small is not worth a word
_SLACK = 1.1  # tanh gets to its ends only slowly
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # glibc's malloc.h
_TOP_PAD = 256 * 2**20  # bytes
_CONVOLUTION_DIMENSIONS = 4  # of its weights

_LARGEST = 10.0  # what is normalised and would need more than this has not been demonstrated at all


@dataclass
class Learner:
    """Everything that learns, and everything between it and the data.

    Attributes:
        accelerator: Device, precision and processes.
        policy: The policy, as `accelerator` wraps it.
        optimizer: Its optimizer.
        scheduler: Of the learning rate; None means constant.
        preprocessor: From batches to what the policy takes.
        postprocessor: From what the policy returns to actions.
        action_names: Of the action's dimensions; None: they have none.
        step: Updates done.
    """

    accelerator: Accelerator
    policy: PreTrainedPolicy
    optimizer: Optimizer
    scheduler: Any
    preprocessor: PolicyProcessorPipeline
    postprocessor: PolicyProcessorPipeline
    action_names: Sequence[str] | None = None
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
        self.step += 1
        rate, of_all = self.optimizer.param_groups[0]["lr"], mean_over_processes(loss.detach())
        figures = {**(figures or {}), "loss": of_all, "grad_norm": norm, "lr": rate}
        if accelerator.device.type == "cuda":
            figures["gpu_mem_gb"] = torch.cuda.max_memory_allocated() / 2**30
        return {**figures, "update_s": time.perf_counter() - start}

    @torch.no_grad()
    def loss(self, batch: Mapping[str, Any]) -> float:
        """The policy's loss on a batch, as it would be in a rollout: no augmentation, no dropout."""
        policy = self.unwrapped
        policy.eval()
        with self.accelerator.autocast():
            loss, _ = policy.forward(self.preprocessor(dict(batch)))
        policy.train()
        return float(loss)

    @property
    def unwrapped(self) -> Any:
        """The policy itself, of one process. The wrapped one waits for the others."""
        return self.accelerator.unwrap_model(self.policy)

    def save(self, cfg: PlaybyearTrainConfig) -> Path:
        """Write a checkpoint where lerobot-train would, as a whole or not at all, and return its folder."""
        folder = get_step_checkpoint_dir(Path(str(cfg.output_dir)), cfg.steps, self.step)
        folder.parent.mkdir(parents=True, exist_ok=True)
        aside = folder.with_name(f".{folder.name}.old")
        with new_folder(folder) as partial:
            self.write_checkpoint(partial, cfg)
            flush_all(partial)
            shutil.rmtree(aside, ignore_errors=True)
            if folder.is_dir():  # of an attempt that went further than what this one began with
                folder.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)
        replace_link(folder.with_name(LAST_CHECKPOINT_LINK), folder.name)
        if cfg.save_checkpoint_to_hub and cfg.policy and cfg.policy.repo_id:
            push_checkpoint(folder, cfg.policy.repo_id, cfg.policy.private)
        return folder

    def write_checkpoint(self, folder: Path, cfg: PlaybyearTrainConfig) -> None:
        """Write LeRobot's checkpoint into a folder."""
        names = ("step", "optimizer", "scheduler", "preprocessor", "postprocessor")
        parts = {name: getattr(self, name) for name in names}
        save_checkpoint(self.accelerator, cfg, checkpoint_dir=folder, policy=self.unwrapped, **parts)

    def evaluate(self, cfg: PlaybyearTrainConfig, n_videos: int = 4) -> dict[str, Any]:
        """Roll the policy out in the run's environment through LeRobot's `eval_policy_all`, and return its report.

        Where the environments say of each episode whether the hand acted before anything was heard (`acted_early`), its
        `overall` has the share of these episodes, `pc_acted_early` [%], too.
        """
        assert cfg.env is not None
        env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_cfg=cfg.env, policy_cfg=cfg.policy)
        envs = make_env(cfg.env, n_envs=cfg.eval.batch_size, use_async_envs=cfg.eval.use_async_envs)
        videos = Path(str(cfg.output_dir)) / "eval" / f"videos_step_{get_step_identifier(self.step, cfg.steps)}"
        try:
            with torch.no_grad(), self.accelerator.autocast():
                info = eval_policy_all(
                    envs=envs,
                    policy=self.unwrapped,
                    env_preprocessor=env_preprocessor,
                    env_postprocessor=env_postprocessor,
                    preprocessor=self.preprocessor,
                    postprocessor=self.postprocessor,
                    n_episodes=cfg.eval.n_episodes,
                    videos_dir=videos,
                    max_episodes_rendered=n_videos,
                    start_seed=cfg.seed,
                    max_parallel_tasks=cfg.env.max_parallel_tasks,
                )
        finally:
            close_envs(envs)
            self.policy.train()
        each_env = [env for group in envs.values() for env in group.values()]
        of_each = [getattr(env, "acted_early", ())[: cfg.eval.n_episodes] for env in each_env]
        told = [early for episodes in of_each for early in episodes if early is not None]
        if told:
            info["overall"]["pc_acted_early"] = 100.0 * sum(told) / len(told)
        return info

    def warn_of_reach(self, actions: Tensor, what: str) -> None:
        """Logs which actions the policy cannot learn, if there are any, and what to do.

        The policy ends at `action_range` times the normalised range of the actions that its statistics were made of.

        Args:
            actions: (N, n_actions), as recorded; (N,) of a single one, as LeRobot keeps it.
            what: What they are, for the message.
        """
        config = self.unwrapped.config
        if len(actions) == 0:
            return
        actions = actions.reshape(len(actions), -1)
        needed = self._normalized(actions).abs().cpu()  # (N, n_actions)
        is_out = needed > config.action_range * (1 + _TOLERANCE)
        if not is_out.any():
            return
        names = self.action_names or [f"action[{i}]" for i in range(actions.shape[1])]
        shares = {name: float(share) for name, share in zip(names, is_out.float().mean(dim=0), strict=True) if share}
        farthest = dict(zip(names, needed.amax(dim=0).tolist(), strict=True))
        is_normalized = config.normalization_mapping.get("ACTION") != NormalizationMode.IDENTITY
        largest = _LARGEST if is_normalized else math.inf
        unmoved = [f"'{name}'" for name in shares if farthest[name] > largest]
        reachable = [farthest[name] for name in shares if farthest[name] <= largest]
        listed = ", ".join(f"'{name}' in {100 * share:.1f} %" for name, share in shares.items())
        text = (
            f"Some actions of {what} are out of the policy's reach: {listed} of {len(actions)} frames lie beyond the end of "
            f"its last layer (action_range={config.action_range:g}, normalised), and are learned as that end."
        )
        if reachable:
            option = f"--policy.action_range={math.ceil(10 * _SLACK * max(reachable)) / 10:g}"
            text += (
                f" Train with {option}; a trained policy gets it with playbyear-train --preset=cpu --policy.path=... {option} "
                "on its demonstrations."
            )
        if unmoved:
            text += f" {', '.join(unmoved)} hardly moves in the demonstrations: demonstrate it too."
        logging.warning(text)

    def _normalized(self, actions: Tensor) -> Tensor:
        """As the preprocessor does where there is nothing but actions: other steps may want an observation."""
        transition = create_transition(observation={}, action=actions.float().to(self.accelerator.device))
        for step in self.preprocessor.steps:
            if isinstance(step, NormalizerProcessorStep):
                transition = step(transition)
        normalized: Tensor = transition[TransitionKey.ACTION]  # type: ignore[assignment]
        return normalized


def make_learner(
    cfg: PlaybyearTrainConfig,
    meta: LeRobotDatasetMetadata,
    keep_normalization: bool = False,
    accelerator: Accelerator | None = None,
) -> Learner:
    """Make policy, processors, optimizer and schedule for a dataset; where the run is resumed, from its checkpoint.

    Args:
        cfg: The options of the run.
        meta: The dataset's metadata.
        keep_normalization: Whether a checkpoint's statistics stay as they are, those of sound included; otherwise the
            dataset's take their place.
        accelerator: Of `make_accelerator`; None makes one.

    Raises:
        ValueError: If the dataset does not suit the policy, before the policy is made.
        InputError: If the recordings of noise that it learns with cannot be used.
    """
    assert isinstance(cfg.policy, PlaybyearConfig)
    keep_freed_memory()
    check_dataset_suits(cfg.policy, meta, cfg.rename_map)
    if cfg.policy.pretrained_path:
        check_steps(cfg.policy.pretrained_path, getattr(cfg.policy, "pretrained_revision", None))
    policy = make_policy(cfg=cfg.policy, ds_meta=meta, rename_map=cfg.rename_map)
    if cfg.policy.auxiliary_way and not cfg.policy.low_dimensional_keys:
        logging.info("--policy.auxiliary_way is left out: the policy observes nothing that moves with the hand")
    assert isinstance(policy, PlaybyearPolicy)
    if keep_normalization:
        policy.keep_normalization()
    if cfg.policy.use_audio:
        policy.model.disturb.read_recordings()
    accelerator = accelerator or make_accelerator(cfg.policy)
    stats = None if cfg.resume or keep_normalization else meta.stats
    preprocessor, postprocessor = _make_processors(cfg, policy, stats, accelerator.device)
    optimizer, scheduler = make_optimizer_and_scheduler(cfg, policy)
    step = 0
    if cfg.resume and cfg.checkpoint_path is not None:
        step = load_training_state(cfg.checkpoint_path, optimizer, scheduler)
    if accelerator.device.type == "cuda":
        policy.to(accelerator.device)  # before its weights and the optimizer's state are laid out again
        prepare_for_gpu(policy, optimizer)
    if cfg.compile:
        compile_networks(policy)
    policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
    policy.train()
    names = number_names(meta.features[ACTION])
    return Learner(accelerator, policy, optimizer, scheduler, preprocessor, postprocessor, names, step)


def make_accelerator(policy: PlaybyearConfig) -> Accelerator:
    """The Accelerator that lerobot-train makes for a policy: its device, its precision, and the processes launched."""
    kind, is_cpu = _DTYPES.get(policy.dtype or ""), policy.device == "cpu"
    patient = InitProcessGroupKwargs(timeout=_PATIENCE)
    return Accelerator(step_scheduler_with_optimizer=False, mixed_precision=kind, cpu=is_cpu, kwargs_handlers=[patient])


def noise_seed(seed: int, process_index: int, step: int) -> int:
    """The seed of what a process of several draws by itself, such as augmentation, from an update on.

    Args:
        seed: Of the run.
        process_index: Of the process.
        step: Updates done before; a run that goes on draws other noise than at its begin.
    """
    if step == 0:
        return seed + process_index
    return int(np.random.SeedSequence([seed, process_index, step]).generate_state(1)[0])


def load_training_state(checkpoint: Path, optimizer: Optimizer, scheduler: Any) -> int:
    """Reads what LeRobot wrote beside the policy, before the optimizer is prepared: random numbers, optimizer, schedule.

    LeRobot's own function for this is another one in every version; the parts that it calls stay.

    Args:
        checkpoint: `<run>/checkpoints/<step>`.
        optimizer: Gets its state.
        scheduler: Gets its state; None: there is none.

    Returns:
        Updates done.

    Raises:
        NotADirectoryError: The checkpoint has no training state.
        ValueError: The number of its updates is none.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    if not folder.is_dir():
        raise NotADirectoryError(folder)
    load_rng_state(folder)
    load_optimizer_state(optimizer, folder)
    if scheduler is not None:
        load_scheduler_state(scheduler, folder)
    try:
        return int(parse_json((folder / TRAINING_STEP).read_bytes())["step"])
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise ValueError(f"{folder / TRAINING_STEP} is damaged: {error}. Put it back from a copy.") from error


def check_dataset_suits(policy: PlaybyearConfig, meta: LeRobotDatasetMetadata, rename_map: Renamed = None) -> None:
    """Refuse a dataset whose frame rate or features a policy was not made for.

    Raises:
        ValueError: Naming what was seen, what is wanted, and what to do.
    """
    policy.check_frame_rate(meta)
    used = dataset_names(policy, rename_map).values()  # none of a new policy, which takes all
    for key, feature in meta.features.items():
        if problem := _why_not(key, feature, key in used or not used, policy.use_vision):
            raise ValueError(f"'{key}' {problem}. Leave it out: {without_feature(Path(meta.root), key)}")
    missing = [key for key in used if key not in meta.features]
    if missing:
        seen = [key for key in meta.features if key.startswith(OBS_STR)]
        raise ValueError(
            f"The dataset '{meta.repo_id}' lacks {missing}, which the policy needs; its observations are {seen}. "
            "Use a dataset with these keys, or map its names with --rename_map."
        )


def _why_not(key: str, feature: Mapping[str, Any], is_used: bool, is_seen: bool) -> str:
    """What of a feature a policy cannot learn from; empty where nothing."""
    dtype, shape = feature["dtype"], tuple(feature["shape"])
    if dtype in ("image", "video"):
        if len(feature.get("names") or ()) != len(shape):  # LeRobot reads those of all cameras
            names = "['height', 'width', 'channels']"
            return f"has names {feature.get('names')}; wanted what its dimensions are, such as {names}, in {INFO_PATH}"
        if is_used and is_seen and is_depth(feature):
            return "holds distances of a depth camera; wanted colours"
        if is_used and is_seen and 3 not in (shape[0], shape[-1]):
            return f"has shape {shape}; wanted three channels, (H, W, 3)"
    elif is_used and key.startswith(f"{OBS_STR}."):
        if dtype in ("bool", "string", "language"):
            return f"has dtype {dtype}, which LeRobot cannot normalise; wanted float32"
        if len(shape) != 1:
            return f"has shape {shape}; wanted one dimension"
    return ""


def _make_processors(
    cfg: PlaybyearTrainConfig, policy: PreTrainedPolicy, dataset_stats: Any, device: torch.device
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Pre- and postprocessor: new ones, or a checkpoint's with new statistics.

    Without statistics those of the checkpoint stay; so does a resumed run in lerobot-train. Its own steps for sound are made
    with its options, or those given now.
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
        steps = {name: microphone_step(name, config).get_config() for name in config.audio_steps}
        kwargs["preprocessor_overrides"] |= steps
        unnormalizer = {"features": config.output_features, "norm_map": norm_map, **stats}
        kwargs["postprocessor_overrides"] = {"unnormalizer_processor": unnormalizer}
    path, revision = config.pretrained_path, getattr(config, "pretrained_revision", None)
    try:
        return make_pre_post_processors(policy_cfg=config, pretrained_path=path, pretrained_revision=revision, **kwargs)
    except KeyError as error:
        if not config.pretrained_path or not config.audio_steps:
            raise
        raise ValueError(
            f"--policy.audio_steps={','.join(config.audio_steps)} names a step that {path} was trained without, and a trained "
            f"policy keeps its steps: leave the option out, or train a new one. LeRobot: {error}"
        ) from error


# What makes updates faster and changes nothing that is learned (docs/how_to/train.md)


def keep_freed_memory() -> None:
    """Makes glibc keep freed memory for the next update instead of giving it back to the system after every one.

    The network's intermediate results are megabytes each and are freed at every update; handing their pages back and forth
    takes a quarter of an update's time on a CPU. Without glibc nothing happens.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is not None:
        for parameter, value in ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, _TOP_PAD)):
            mallopt(parameter, value)


def prepare_for_gpu(policy: nn.Module, optimizer: Optimizer) -> None:
    """Lays the weights of convolutions out as a GPU's tensor cores read them, and makes Adam's step one kernel.

    The optimizer's state is laid out like the weights, and none of it need lie on the host, so nothing waits for it.
    Checkpoints stay as they are: safetensors saves contiguous tensors alone, and LeRobot resumes none whose options have
    other types than the optimizer's, where `fused` was not set.

    Args:
        policy: Whatever learns.
        optimizer: Of its parameters; it may have a state already.
    """
    policy.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer.register_state_dict_post_hook(_as_saved)
    optimizer.register_load_state_dict_post_hook(_as_on_gpu)
    _as_on_gpu(optimizer)


def compile_networks(policy: PlaybyearPolicy) -> None:
    """Compiles the encoders and the head when they are first used; names of weights stay."""
    network = policy.model
    parts: list[nn.Module] = [network.fusion, network.memory_head.head]
    parts += [encoder.network for encoder in network.modules() if isinstance(encoder, VisionEncoder)]
    if policy.config.use_audio:
        parts += network.hearing.values()
    for part in parts:
        part.compile()


def _as_saved(optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    def saved(values: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value.contiguous() if isinstance(value, Tensor) else value for key, value in values.items()}

    fused = {"fused": None} if isinstance(optimizer, Adam) else {}
    groups = [{**group, **fused} for group in state["param_groups"]]
    return {**state, "state": {n: saved(values) for n, values in state["state"].items()}, "param_groups": groups}


def _as_on_gpu(optimizer: Optimizer) -> None:
    for parameter, values in optimizer.state.items():
        for key, value in values.items():
            if isinstance(value, Tensor) and value.dim() == _CONVOLUTION_DIMENSIONS:
                values[key] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)
            elif key == "step" and isinstance(optimizer, Adam):
                values[key] = value.to(parameter.device)
    for group in optimizer.param_groups if isinstance(optimizer, Adam) else ():
        group["fused"] = True
