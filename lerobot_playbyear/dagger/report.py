"""What a run tells a person, a file and W&B: how it goes, what an expert spent, and what it brought."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.run_folder import RunFolder, RunState
from lerobot_playbyear.datasets.parquet import stretches
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
        totals: What all attempts of the run cost so far, as `totals_of` says it.
    """

    def __init__(self, cfg: DaggerConfig, training: PlaybyearTrainConfig, folder: RunFolder, state: RunState) -> None:
        training.resume, training.wandb.run_id = state.wandb_run_id is not None, state.wandb_run_id
        episodes = (cfg.num_episodes, state.kept, "episode")
        counted = episodes if cfg.is_online else (cfg.steps, state.step, "update")
        super().__init__(training, state, *counted, "HG-DAgger")
        training.resume = False  # checkpoints of a resumed run are those of one that was not
        state.wandb_run_id = training.wandb.run_id = self._wandb.cfg.run_id if self._wandb else None
        self._cfg, self._folder, self._state = cfg, folder, state
        self.success = state.success
        self._lines = folder.metrics()
        self.totals = totals_of(self._lines)

    def doing(self, what: str) -> None:
        """What the run is at, behind the bar."""
        state = self._state
        success = "" if self.success is None else f", success {self.success:.0f} %"
        needed = state.attempts - state.unneeded - state.discarded
        expert = f", expert needed in {needed / state.attempts:.0%} of {state.attempts}" if state.attempts else ""
        if state.attempts:
            expert += f" ({self.totals['expert_steps']} steps), autonomy {self.totals['autonomy']:.0%}"
        self.bar.set_postfix_str(f"{what}{expert}{success}")

    def write_evaluation(self, info: dict[str, Any], **more: float) -> None:
        """What an evaluation gave."""
        if self.totals["attempts"] or self._cfg.is_online:
            more |= {name: self.totals[name] for name in ("expert_steps", "person_seconds")}
        super().write_evaluation(info, **more)
        n_episodes = info["overall"]["n_episodes"]
        logging.info(f"Evaluation after {self._state.round} rounds: {self.success:.1f} % of {n_episodes} episodes")

    def write(self, kind: str, figures: dict[str, Any]) -> None:
        """Figures of one kind, with where the run is."""
        state = self._state
        place = {"attempt": state.attempts, "round": state.round, "step": state.step}
        line = {"kind": kind, **place, **figures}
        self._folder.append_metrics(line)
        self._lines.append(line)
        self.totals = totals_of(self._lines)
        self._to_wandb(kind, {name: value for name, value in (place | figures).items() if not isinstance(value, list)})


def attempt_figures(by_expert: np.ndarray, fps: float, is_watched: bool) -> dict[str, Any]:
    """What one attempt cost.

    Args:
        by_expert: (T,) bool, where the expert acted.
        fps: Steps per second of a person, or of one in a script's place.
        is_watched: Whether a person would have to watch all of it, and not only act.

    Returns:
        `n_expert_steps`; `n_takeovers`; `takeover_steps`, the length of each; `n_switches` of control, either way; `autonomy`,
        the share of steps in which the policy acted; `person_seconds`.
    """
    lengths = [int(after - first) for first, after in stretches(by_expert)]
    n_expert_steps = int(by_expert.sum())
    spent = len(by_expert) if is_watched else n_expert_steps
    return {
        "n_expert_steps": n_expert_steps,
        "n_takeovers": len(lengths),
        "takeover_steps": lengths,
        "n_switches": int((np.diff(by_expert.astype(int)) != 0).sum()),
        "autonomy": round(1 - float(by_expert.mean()), 4),
        "person_seconds": round(spent / fps, 2),
    }


def totals_of(lines: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What attempts cost together.

    Args:
        lines: Lines of `metrics.jsonl`; those without an attempt's figures do not matter.

    Returns:
        `attempts`, how many there were; `expert_steps`, in which the expert acted; `takeovers` and `switches` of control;
        `person_seconds` of a person's time; `autonomy`, the share of the steps in which the policy acted, 1 without an attempt.
    """
    names = ("n_frames", "n_expert_steps", "n_takeovers", "n_switches", "person_seconds")
    attempts = [line for line in lines if all(isinstance(line.get(name), int | float) for name in names)]
    steps, expert_steps, takeovers, switches, seconds = (sum(line[name] for line in attempts) for name in names)
    totals = {"attempts": len(attempts), "expert_steps": expert_steps, "takeovers": takeovers, "switches": switches}
    return totals | {"person_seconds": round(seconds, 2), "autonomy": 1 - expert_steps / steps if steps else 1.0}


def round_figures(lines: Sequence[Mapping[str, Any]], number: int) -> dict[str, Any]:
    """What is said of a round: what the expert spent in the run so far, and in this round's attempts.

    Args:
        lines: The lines of `metrics.jsonl`.
        number: Of the round, counted from 1. Its attempts stand in lines that count the rounds before.
    """
    totals, own = totals_of(lines), totals_of(line for line in lines if line.get("round") == number - 1)
    spent = {name: totals[name] for name in ("expert_steps", "takeovers", "switches", "person_seconds")}
    return {**spent, "autonomy": round(own["autonomy"], 4)}
