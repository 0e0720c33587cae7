"""Telling a person, a file and W&B how a run goes."""

import logging
from typing import Any

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.figures import Totals
from lerobot_playbyear.dagger.folder import RunFolder, RunState
from lerobot_playbyear.training.config import PlaybyearTrainConfig
from lerobot_playbyear.training.report import Progress


class Report(Progress):
    """One line of progress for a person, one line of JSON per attempt, round and evaluation.

    Args:
        cfg: The options; they say whether the bar counts attempts or updates.
        training: The same, for W&B.
        folder: Where the lines go.
        state: The run's counters, which are only read, and its name in W&B, which is gone on with or noted.

    Attributes:
        totals: What all attempts of the run cost so far.
    """

    def __init__(self, cfg: DaggerConfig, training: PlaybyearTrainConfig, folder: RunFolder, state: RunState) -> None:
        training.resume, training.wandb.run_id = state.wandb_run_id is not None, state.wandb_run_id
        if cfg.is_online:
            done = (state.first_episodes or 0) + state.kept
            super().__init__(training, state, cfg.episodes, done, "episode", "HG-DAgger")
        else:
            super().__init__(training, state, cfg.updates, state.step, "update", "HG-DAgger")
        training.resume = False  # checkpoints of a resumed run are those of one that was not
        state.wandb_run_id = training.wandb.run_id = self._wandb.cfg.run_id if self._wandb else None
        self._cfg, self._folder, self._state = cfg, folder, state
        self.success = state.success
        self.totals = Totals.of(folder.metrics())

    def doing(self, what: str) -> None:
        """What the run is at, behind the bar."""
        state = self._state
        success = "" if self.success is None else f", success {self.success:.0f} %"
        needed = state.attempts - state.unneeded - state.discarded
        expert = f", expert needed in {needed / state.attempts:.0%} of {state.attempts}" if state.attempts else ""
        if state.attempts:
            expert += f" ({self.totals.expert_steps} steps), autonomy {self.totals.autonomy:.0%}"
        self.bar.set_postfix_str(f"{what}{expert}{success}")

    def write_evaluation(self, info: dict[str, Any], **more: float) -> None:
        """What an evaluation gave."""
        if self.totals.attempts or self._cfg.is_online:
            more |= {"expert_steps": self.totals.expert_steps, "person_seconds": self.totals.person_seconds}
        super().write_evaluation(info, **more)
        n_episodes = info["overall"]["n_episodes"]
        logging.info(f"Evaluation after {self._state.round} rounds: {self.success:.1f} % of {n_episodes} episodes")

    def write(self, kind: str, figures: dict[str, Any]) -> None:
        """Figures of one kind, with where the run is."""
        state = self._state
        place = {"attempt": state.attempts, "round": state.round, "step": state.step}
        line = {"kind": kind, **place, **figures}
        self._folder.append_metrics(line)
        self.totals.add(line)
        self._to_wandb(kind, {name: value for name, value in (place | figures).items() if not isinstance(value, list)})
