"""What a training tells of itself: a bar, the log, a file of figures, and W&B."""

import json
import logging
import time
from pathlib import Path
from typing import Any

from lerobot.utils.utils import inside_slurm
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_playbyear.compat import WandBLogger
from lerobot_playbyear.datasets.episode_store import EpisodeStore
from lerobot_playbyear.hub.training_run import METRICS_NAME
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.metrics import make_tracker
from lerobot_playbyear.training.parts import TrainingParts


class Report:
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

    def __enter__(self) -> "Report":
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


def print_results(cfg: PlaybyearTrainConfig, success: float | None) -> None:
    """Where everything is, and what to type next."""
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
