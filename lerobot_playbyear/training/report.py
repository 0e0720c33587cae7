"""What a training tells of itself: a bar, the log, a file of figures, and W&B."""

import abc
import json
import logging
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import torch
from accelerate import Accelerator, PartialState
from lerobot.envs.configs import EnvConfig
from lerobot.utils.logging_utils import AverageMeter
from lerobot.utils.utils import inside_slurm
from torch import Tensor
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_playbyear.compat import WandBLogger, metrics_tracker
from lerobot_playbyear.datasets.errors import printable
from lerobot_playbyear.datasets.files import append_line
from lerobot_playbyear.hub.push import METRICS_NAME
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.learner import Learner
from lerobot_playbyear.training.store import EpisodeStore

_MOST_WAITING = 1000  # updates


class Progress(abc.ABC):
    """A bar with the log above it, and W&B: what all that learns tells of itself in the same way.

    Args:
        cfg: Options, for W&B.
        counter: Its `step` says how many updates are done; it is read, never changed.
        total: What the bar counts to.
        done: Where it begins.
        unit: Of what it counts.
        name: What stands before it.

    Attributes:
        bar: The bar.
        success: What the last evaluation gave [%]; None before.
        acted_early: In how many of its episodes the hand acted before anything was heard [%]; None where nobody tells.
    """

    def __init__(self, cfg: PlaybyearTrainConfig, counter: Any, total: int, done: int, unit: str, name: str) -> None:
        self._counter = counter
        self._is_told = PartialState().is_main_process
        is_uploaded = self._is_told and cfg.wandb.enable and cfg.wandb.project
        self._wandb = WandBLogger(cfg) if is_uploaded else None
        self._redirect = logging_redirect_tqdm()
        quiet = inside_slurm() or not self._is_told
        self.bar: tqdm = tqdm(total=total, initial=done, desc=name, unit=unit, disable=quiet)
        self.success: float | None = None
        self.acted_early: float | None = None

    def __enter__(self) -> Self:
        self._redirect.__enter__()
        for handler in logging.getLogger().handlers:  # tqdm's take the place of LeRobot's, but not their level
            handler.setLevel(max(handler.level, logging.INFO))
        return self

    def __exit__(self, *error: Any) -> None:
        self.bar.close()
        self._redirect.__exit__(*error)

    @abc.abstractmethod
    def write(self, kind: str, figures: dict[str, Any]) -> None:
        """Figures of one kind at this step."""

    def write_evaluation(self, info: dict[str, Any], **more: float) -> None:
        """What a roll-out in the environment gave.

        Args:
            info: As LeRobot gives it.
            more: Further figures.
        """
        overall = info["overall"]
        self.success, self.acted_early = float(overall["pc_success"]), overall.get("pc_acted_early")
        self.write("eval", {k: v for k, v in overall.items() if isinstance(v, int | float)} | more)
        if self._wandb and overall.get("video_paths"):
            self._wandb.log_video(overall["video_paths"][0], self._counter.step, mode="eval")

    def _to_wandb(self, kind: str, figures: dict[str, Any]) -> None:
        if self._wandb:
            mode = "eval" if kind in ("eval", "validation") else "train"
            self._wandb.log_dict(figures, self._counter.step, mode=mode)


class Report(Progress):
    """Tells a person, a file and W&B how training goes."""

    def __init__(self, cfg: PlaybyearTrainConfig, store: EpisodeStore, learner: Learner) -> None:
        super().__init__(cfg, learner, cfg.steps, learner.step, "step", "Training")
        self._path = Path(str(cfg.output_dir)) / METRICS_NAME
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._began = time.perf_counter()
        self._figures = Figures(cfg.batch_size, store, learner.step, learner.accelerator)

    def updated(self, figures: Mapping[str, Any]) -> None:
        """One more update is done, with these figures."""
        self._figures.add(figures)
        self.bar.update(1)

    def write_training(self) -> None:
        """The figures since the last time. Every process has to call it."""
        figures, line = self._figures.read()
        self.bar.set_postfix(loss=f"{figures['loss']:.4f}", refresh=False)
        self.write("train", {key: value for key, value in figures.items() if key != "steps"}, line)

    def write(self, kind: str, figures: dict[str, Any], text: str | None = None) -> None:
        """Figures of one kind at this step, of the first process."""
        if not self._is_told:
            return
        numbers = ", ".join(f"{key} {value:.4g}" for key, value in figures.items())
        logging.info(text or f"{kind} at step {self._counter.step}: {numbers}")
        elapsed = round(time.perf_counter() - self._began, 2)
        line = {"kind": kind, "step": self._counter.step, "elapsed_s": elapsed, **figures}
        append_line(self._path, json.dumps(line))
        self._to_wandb(kind, figures)

    def saved(self, checkpoint: Path) -> None:
        """A checkpoint is on disk."""
        logging.info(f"Checkpoint: {checkpoint}")
        if self._wandb:
            self._wandb.log_policy(checkpoint)


def is_due(step: int, every: int) -> bool:
    """Whether something that is done every so many steps is done after this one; 0: never."""
    return every > 0 and step % every == 0


def print_results(cfg: PlaybyearTrainConfig, success: float | None, acted_early: float | None) -> None:
    """Where everything is, and what to type next."""
    folder = Path(str(cfg.output_dir))
    print(f"\nFigures:    {folder / METRICS_NAME}")
    if success is not None:
        print(f"Success:    {success:.1f} % of {cfg.eval.n_episodes} episodes, videos in {folder / 'eval'}")
    if acted_early is not None:
        print(f"Early:      {acted_early:.1f} % of them acted before anything was heard")
    if cfg.save_checkpoint:
        policy = folder / "checkpoints" / "last" / "pretrained_model"
        config = shlex.quote(str(policy / "train_config.json"))
        print(f"Policy:     {policy}")
        print(f"Evaluate:   {evaluation_command(policy, cfg.env)}")
        print(f"Go on:      playbyear-train --resume=true --config_path={config} --steps={2 * cfg.steps}")


def evaluation_command(policy: Path, env: EnvConfig | None) -> str:
    """What to type to evaluate a policy where it was trained or corrected."""
    if env is None:
        return printable(f"lerobot-eval --policy.path={shlex.quote(str(policy))} --env.type=...")
    options = {"policy.path": policy, "env.type": env.type, "env.task": env.task}
    ears = getattr(env, "microphones", None) or []
    if len(ears) > 1:
        options["env.microphones"] = json.dumps(ears, separators=(",", ":"))
    return printable(shlex.join(["lerobot-eval", *(f"--{name}={value}" for name, value in options.items())]))


class Figures:
    """Averages over updates. Numbers stay on the GPU until somebody reads them, so that no update waits for one.

    Args:
        batch_size: Items per update and process.
        store: What they are drawn from.
        step: Updates done before.
        accelerator: Of the processes whose figures are averaged.
    """

    def __init__(self, batch_size: int, store: EpisodeStore, step: int, accelerator: Accelerator) -> None:
        means = {
            "loss": AverageMeter("loss", ":.3f", reduction="mean"),
            "grad_norm": AverageMeter("grdn", ":.3f"),
            "lr": AverageMeter("lr", ":0.1e"),
            "update_s": AverageMeter("updt_s", ":.3f", reduction="max"),
            "dataloading_s": AverageMeter("data_s", ":.3f", reduction="max"),
        }
        if torch.cuda.is_available():
            means["gpu_mem_gb"] = AverageMeter("mem_gb", ":.2f")
        self._tracker = metrics_tracker(accelerator, batch_size, len(store), store.n_episodes, means, initial_step=step)
        self._waiting: list[Mapping[str, Any]] = []

    def add(self, figures: Mapping[str, Any]) -> None:
        """Those of one more update: numbers, or tensors of one number."""
        self._waiting.append(figures)
        self._tracker.step()
        if len(self._waiting) >= _MOST_WAITING:
            self._take_in()

    def read(self) -> tuple[dict[str, float], str]:
        """The averages since the last time, by name and as a line. Every process has to call it."""
        self._take_in()
        self._tracker.reduce_across_ranks()
        figures, line = self._tracker.to_dict(), str(self._tracker)
        self._tracker.reset_averages()
        return figures, line

    def _take_in(self) -> None:
        tensors = [v.detach().float() for each in self._waiting for v in each.values() if isinstance(v, Tensor)]
        numbers = iter(torch.stack(tensors).tolist() if tensors else [])
        for each in self._waiting:
            values = {name: next(numbers) if isinstance(v, Tensor) else v for name, v in each.items()}
            for name in values.keys() & self._tracker.metrics.keys():
                self._tracker.metrics[name].update(values[name])
            self._tracker.update_metrics({name: v for name, v in values.items() if name not in self._tracker.metrics})
        self._waiting.clear()
