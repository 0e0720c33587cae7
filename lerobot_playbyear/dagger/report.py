"""Telling a person, a file and W&B how a run goes."""

import logging
from typing import Any

from lerobot.utils.utils import inside_slurm
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from lerobot_playbyear.compat import WandBLogger
from lerobot_playbyear.dagger.folder import RunFolder, RunState
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.training.config import PlaybyearTrainConfig


class Report:
    """One line of progress for a person, one line of JSON per attempt, round and evaluation.

    Args:
        folder: Where the lines go.
        state: The run's counters; they are read, never changed.
        training: Options, for W&B.
        total: Attempts, or updates, that the bar counts to.
        unit: Which of both.
    """

    def __init__(
        self, folder: RunFolder, state: RunState, training: PlaybyearTrainConfig, total: int, unit: str
    ) -> None:
        self._folder, self._state = folder, state
        self._wandb = WandBLogger(training) if training.wandb.enable and training.wandb.project else None
        self._redirect = logging_redirect_tqdm()
        done = (state.first_episodes or 0) + state.kept if unit == "episode" else state.step
        self._bar: tqdm = tqdm(total=total, initial=done, unit=unit, desc="HG-DAgger", disable=inside_slurm())
        self._success = state.success

    @property
    def wandb_run_id(self) -> str | None:
        """Of the run in W&B, None without."""
        return self._wandb.cfg.run_id if self._wandb else None

    def __enter__(self) -> "Report":
        self._redirect.__enter__()
        for handler in logging.getLogger().handlers:  # tqdm's take the place of LeRobot's, but not their level
            handler.setLevel(max(handler.level, logging.INFO))
        return self

    def __exit__(self, *error: Any) -> None:
        self._bar.close()
        self._redirect.__exit__(*error)

    def doing(self, what: str) -> None:
        """What the run is at, behind the bar."""
        state = self._state
        success = "" if self._success is None else f", success {self._success:.0f} %"
        needed = state.attempts - state.unneeded - state.discarded
        expert = f", expert needed in {needed / state.attempts:.0%} of {state.attempts}" if state.attempts else ""
        self._bar.set_postfix_str(f"{what}{expert}{success}")

    def advance(self, n: int = 1) -> None:
        """The bar goes on."""
        self._bar.update(n)

    def attempt(self, episode: Episode, outcome: str, seconds: dict[str, float]) -> None:
        """An attempt has ended."""
        self.write(
            "attempt",
            {
                "seed": episode.seed,
                "outcome": outcome,
                "success": episode.success,
                "n_frames": len(episode),
                "intervention_share": round(episode.intervention_share, 4),
                **{f"{name}_s": round(value, 4) for name, value in seconds.items()},
            },
        )

    def evaluation(self, info: dict[str, Any], seconds: float) -> None:
        """An evaluation has ended; `info` as LeRobot gives it."""
        overall = info["overall"]
        self._success = float(overall["pc_success"])
        figures = {key: value for key, value in overall.items() if isinstance(value, int | float)}
        self.write("eval", {**figures, "evaluation_s": round(seconds, 3)})
        logging.info(
            f"Evaluation after {self._state.round} rounds: {self._success:.1f} % of {overall['n_episodes']} episodes"
        )
        if self._wandb and overall.get("video_paths"):
            self._wandb.log_video(overall["video_paths"][0], self._state.step, mode="eval")

    def write(self, kind: str, figures: dict[str, Any]) -> None:
        """Figures of one kind, with where the run is."""
        state = self._state
        place = {"attempt": state.attempts, "round": state.round, "step": state.step}
        self._folder.append_metrics({"kind": kind, **place, **figures})
        if self._wandb:
            self._wandb.log_dict({**place, **figures}, state.step, mode="eval" if kind == "eval" else "train")
