"""playbyear-train: lerobot-train with the dataset in memory.

Takes lerobot-train's options, keeps its output folder and its checkpoints (each resumes the other's), and trains
through LeRobot's own `update_policy`. What is added: the dataset is read once, runs of windows are cut out of memory,
and some moments can be drawn more often than others.

    playbyear-train --preset=cpu --dataset.repo_id=me/demos --dataset.root=outputs/demos --output_dir=outputs/train
    playbyear-train --resume=true --config_path=outputs/train/checkpoints/last/pretrained_model/train_config.json
"""

import json
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import parser
from lerobot.datasets import LeRobotDataset, make_train_eval_datasets
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import format_big_number, init_logging, inside_slurm
from torch import Tensor
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_playbyear.compat import WandBLogger
from lerobot_playbyear.datasets import (
    EpisodeStore,
    RunSampler,
    check_dataset_files,
    loud_frames,
    run_weights,
    start_frames,
)
from lerobot_playbyear.hub.client import patient_hub
from lerobot_playbyear.hub.policies import push_policy
from lerobot_playbyear.hub.pushing import HubError, warn_without_login
from lerobot_playbyear.hub.training_run import METRICS_NAME
from lerobot_playbyear.training.config import PlaybyearTrainConfig, SamplingConfig
from lerobot_playbyear.training.heap import keep_freed_memory
from lerobot_playbyear.training.metrics import make_tracker
from lerobot_playbyear.training.parts import PolicyWindows, TrainingParts, make_training_parts
from lerobot_playbyear.training.presets import apply_preset
from lerobot_playbyear.training.reach import Reach, action_names


class TrainError(ValueError):
    """What a person asked for cannot be trained; the message says why, and what to do."""


@parser.wrap()
def train(cfg: PlaybyearTrainConfig) -> Path:
    """Train a policy.

    Args:
        cfg: The options of the run.

    Returns:
        The output folder.

    Raises:
        TrainError: If an option, the dataset and the policy do not go together, before any work is done; or, after it, if
            the Hub does not take the policy.
    """
    init_logging()
    with _errors_of_input():
        cfg.validate()
        check_dataset_files(cfg.dataset.repo_id, cfg.dataset.root, cfg.dataset.revision)
        if cfg.policy is not None and cfg.policy.push_to_hub:
            warn_without_login()
        if cfg.seed is not None:
            set_seed(cfg.seed)
        _configure_backends(cfg)
        dataset, held_out = make_train_eval_datasets(cfg)
        parts = make_training_parts(cfg, dataset.meta)
        windows = PolicyWindows(parts.policy.config, dataset.meta, cfg.rename_map)
        store = _read(dataset, windows, cfg)
        validation_store = None if held_out is None or cfg.eval_steps <= 0 else _read(held_out, windows, cfg)

    reach = Reach(parts.policy.config, parts.preprocessor, action_names(dataset.meta.features[ACTION]))
    reach.warn(store.column(ACTION), f"the dataset '{cfg.dataset.repo_id}'")
    weights = run_weights(store, windows.n_windows, frame_weights(store, cfg.sampling))
    sampler = RunSampler(weights, cfg.seed or 0)
    sampler.load_state_dict({**sampler.state_dict(), "n_batches": parts.step})
    _log_start(cfg, parts, store)
    with _Report(cfg, store, parts) as report:
        _loop(cfg, parts, windows, store, sampler, validation_store, report)
    _print_results(cfg, report.last_success)
    if cfg.policy is not None and cfg.policy.push_to_hub:
        _push(cfg, parts)
    return Path(str(cfg.output_dir))


def frame_weights(store: EpisodeStore, sampling: SamplingConfig) -> Tensor:
    """How much each frame of a store matters, (N,): the weights of all the moments it belongs to, multiplied."""
    weights = torch.ones(len(store))
    if sampling.start_weight != 1:
        weights[start_frames(store, round(sampling.start_s * store.fps))] *= sampling.start_weight
    if sampling.loud_weight != 1:
        loud = loud_frames(store, sampling.loud_db, max(1, round(sampling.loud_s * store.fps)))
        weights[loud] *= sampling.loud_weight
        logging.info(f"{int(loud.sum())} of {len(store)} frames follow a sudden sound")
    return weights


def validation_loss(parts: TrainingParts, windows: PolicyWindows, store: EpisodeStore, batch_size: int) -> float:
    """The mean loss over held-out episodes; every frame counts once, but for those that do not fill a run."""
    ends = [
        torch.arange(end - 1, start - 1, -windows.n_windows)
        for start, end in zip(store.starts, store.ends, strict=True)
    ]
    batches = torch.cat(ends).split(batch_size)
    losses = [parts.loss(windows.batch(store, last)) * len(last) for last in batches]
    return sum(losses) / sum(len(last) for last in batches)


def _loop(
    cfg: PlaybyearTrainConfig,
    parts: TrainingParts,
    windows: PolicyWindows,
    store: EpisodeStore,
    sampler: RunSampler,
    validation_store: EpisodeStore | None,
    report: "_Report",
) -> None:
    grad_clip_norm = cfg.optimizer.grad_clip_norm if cfg.optimizer is not None else 0.0
    while parts.step < cfg.steps:
        start = time.perf_counter()
        batch = windows.batch(store, sampler.draw(cfg.batch_size))
        report.metrics.dataloading_s = time.perf_counter() - start
        parts.update(batch, report.metrics, grad_clip_norm)
        report.updated()
        is_last = parts.step == cfg.steps
        if _is_due(parts.step, cfg.log_freq):
            report.write_training()
        if validation_store is not None and (_is_due(parts.step, cfg.eval_steps) or is_last):
            report.write("validation", {"loss": validation_loss(parts, windows, validation_store, cfg.batch_size)})
        if cfg.save_checkpoint and (_is_due(parts.step, cfg.save_freq) or is_last):
            report.saved(parts.save(cfg))
        if cfg.env is not None and cfg.env_eval_freq > 0 and (_is_due(parts.step, cfg.env_eval_freq) or is_last):
            report.write_evaluation(parts.evaluate(cfg))


class _Report:
    """Tells a person, a file and W&B how training goes."""

    def __init__(self, cfg: PlaybyearTrainConfig, store: EpisodeStore, parts: TrainingParts) -> None:
        self._cfg, self._parts = cfg, parts
        self._wandb = WandBLogger(cfg) if cfg.wandb.enable and cfg.wandb.project else None
        self._path = Path(str(cfg.output_dir)) / METRICS_NAME
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._redirect = logging_redirect_tqdm()
        self._bar: tqdm = tqdm(
            total=cfg.steps, initial=parts.step, desc="Training", unit="step", disable=inside_slurm()
        )
        self._began, self._first_step = time.perf_counter(), parts.step
        self.last_success: float | None = None
        self.metrics = make_tracker(cfg.batch_size, store, parts.step)

    def __enter__(self) -> "_Report":
        self._redirect.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._bar.close()
        self._redirect.__exit__(*error)

    def updated(self) -> None:
        """One more update is done."""
        self.metrics.step()
        self._bar.update(1)

    def write_training(self) -> None:
        """The figures since the last time."""
        figures = self.metrics.to_dict()
        self._bar.set_postfix(loss=f"{figures['loss']:.4f}", refresh=False)
        self.write("train", {key: value for key, value in figures.items() if key != "steps"}, str(self.metrics))
        self.metrics.reset_averages()

    def write_evaluation(self, info: dict[str, Any]) -> None:
        """What a roll-out in the environment gave."""
        overall = info["overall"]
        self.last_success = float(overall["pc_success"])
        figures = {key: value for key, value in overall.items() if isinstance(value, int | float)}
        self.write("eval", figures)
        if self._wandb and overall.get("video_paths"):
            self._wandb.log_video(overall["video_paths"][0], self._parts.step, mode="eval")

    def write(self, kind: str, figures: dict[str, Any], text: str | None = None) -> None:
        """Figures of one kind at this step."""
        numbers = ", ".join(f"{key} {value:.4g}" for key, value in figures.items())
        logging.info(text or f"{kind} at step {self._parts.step}: {numbers}")
        elapsed = round(time.perf_counter() - self._began, 2)
        with self._path.open("a") as file:
            line = {"kind": kind, "step": self._parts.step, "elapsed_s": elapsed, **figures}
            file.write(json.dumps(line) + "\n")
        if self._wandb:
            self._wandb.log_dict(figures, self._parts.step, mode="train" if kind == "train" else "eval")

    def saved(self, checkpoint: Path) -> None:
        """A checkpoint is on disk."""
        logging.info(f"Checkpoint: {checkpoint}")
        if self._wandb:
            self._wandb.log_policy(checkpoint)


def _read(dataset: LeRobotDataset, windows: PolicyWindows, cfg: PlaybyearTrainConfig) -> EpisodeStore:
    start = time.perf_counter()
    backend = cfg.dataset.video_backend
    store = EpisodeStore.from_dataset(dataset, windows.keys, cfg.store.device, backend, progress=not inside_slurm())
    logging.info(
        f"{len(store)} frames of {store.n_episodes} episodes in memory ({store.nbytes / 2**20:.0f} MiB on "
        f"{store.device}) after {time.perf_counter() - start:.1f} s"
    )
    return store


@contextmanager
def _errors_of_input() -> Iterator[None]:
    try:
        yield
    except (ValueError, FileExistsError, FileNotFoundError, MemoryError) as error:
        raise TrainError(str(error)) from error


def _configure_backends(cfg: PlaybyearTrainConfig) -> None:
    torch.backends.cudnn.deterministic = cfg.cudnn_deterministic
    torch.backends.cudnn.benchmark = not cfg.cudnn_deterministic
    torch.backends.cuda.matmul.allow_tf32 = True


def _is_due(step: int, frequency: int) -> bool:
    return frequency > 0 and step % frequency == 0


def _log_start(cfg: PlaybyearTrainConfig, parts: TrainingParts, store: EpisodeStore) -> None:
    n_parameters = sum(p.numel() for p in parts.policy.parameters() if p.requires_grad)
    logging.info(
        f"{format_big_number(n_parameters)} parameters on {parts.accelerator.device}, steps {parts.step} to {cfg.steps} "
        f"of {cfg.batch_size} runs, output in {cfg.output_dir}"
    )


def _push(cfg: PlaybyearTrainConfig, parts: TrainingParts) -> None:
    """Uploads the last checkpoint, which is on disk and stays there."""
    assert cfg.policy is not None
    assert cfg.policy.repo_id is not None
    folder = (Path(str(cfg.output_dir)) / "checkpoints" / "last") if cfg.save_checkpoint else parts.save(cfg)
    try:
        url = push_policy(folder / "pretrained_model", cfg.policy.repo_id, private=cfg.policy.private)
    except HubError as error:
        raise TrainError(str(error)) from error
    print(f"On the Hub: {url}")


def _print_results(cfg: PlaybyearTrainConfig, success: float | None) -> None:
    folder = Path(str(cfg.output_dir))
    print(f"\nFigures:    {folder / METRICS_NAME}")
    if success is not None:
        print(f"Success:    {success:.1f} % of {cfg.eval.n_episodes} episodes, videos in {folder / 'eval'}")
    if cfg.save_checkpoint:
        policy = folder / "checkpoints" / "last" / "pretrained_model"
        env = f" --env.type={cfg.env.type} --env.task={cfg.env.task}" if cfg.env is not None else " --env.type=..."
        print(f"Policy:     {policy}")
        print(f"Evaluate:   lerobot-eval --policy.path={policy}{env}")
        print(f"Go on:      playbyear-train --resume=true --config_path={policy / 'train_config.json'} --steps=...")


def main() -> None:
    """The command."""
    keep_freed_memory()
    register_third_party_plugins()
    try:
        with _errors_of_input():
            sys.argv[1:] = apply_preset(sys.argv[1:])
        with patient_hub():
            train()
    except TrainError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(
            "Interrupted. Go on from the last checkpoint with --resume=true --config_path=<its train_config.json>."
        )


if __name__ == "__main__":
    main()
