"""Telling a person, a file and W&B how a run goes."""

import logging
from typing import Any

from lerobot_playbyear.dagger.folder import RunFolder, RunState
from lerobot_playbyear.episodes.episode import Episode
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.report import Progress


class Report(Progress):
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
        done = (state.first_episodes or 0) + state.kept if unit == "episode" else state.step
        super().__init__(training, state, total, done, unit, "HG-DAgger")
        self._folder, self._state = folder, state
        self.success = state.success

    @property
    def wandb_run_id(self) -> str | None:
        """Of the run in W&B, None without."""
        return self._wandb.cfg.run_id if self._wandb else None

    def doing(self, what: str) -> None:
        """What the run is at, behind the bar."""
        state = self._state
        success = "" if self.success is None else f", success {self.success:.0f} %"
        needed = state.attempts - state.unneeded - state.discarded
        expert = f", expert needed in {needed / state.attempts:.0%} of {state.attempts}" if state.attempts else ""
        self.bar.set_postfix_str(f"{what}{expert}{success}")

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

    def write_evaluation(self, info: dict[str, Any], **more: float) -> None:
        """What an evaluation gave."""
        super().write_evaluation(info, **more)
        n_episodes = info["overall"]["n_episodes"]
        logging.info(f"Evaluation after {self._state.round} rounds: {self.success:.1f} % of {n_episodes} episodes")

    def write(self, kind: str, figures: dict[str, Any]) -> None:
        """Figures of one kind, with where the run is."""
        state = self._state
        place = {"attempt": state.attempts, "round": state.round, "step": state.step}
        self._folder.append_metrics({"kind": kind, **place, **figures})
        self._to_wandb(kind, {**place, **figures})
