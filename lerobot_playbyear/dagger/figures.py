"""The figures of interactive imitation: what an expert spent, how often control went over, and what it brought."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


def attempt_figures(in_control: np.ndarray, n_expert_steps: int, fps: float, is_watched: bool) -> dict[str, Any]:
    """What one attempt cost.

    Args:
        in_control: (T,) bool, where the expert acted.
        n_expert_steps: Steps for which the expert said what to do; with labels alone more than it acted in.
        fps: Steps per second of a person, or of one in a script's place.
        is_watched: Whether a person would have to watch all of it, and not only act.

    Returns:
        `n_expert_steps`; `n_takeovers`; `takeover_steps`, the length of each; `n_switches` of control, either way; `autonomy`,
        the share of steps in which the policy acted; `person_seconds`.
    """
    changes = np.flatnonzero(np.diff(np.concatenate([[False], in_control, [False]])))
    lengths = (changes[1::2] - changes[::2]).tolist()
    spent = len(in_control) if is_watched else n_expert_steps
    return {
        "n_expert_steps": n_expert_steps,
        "n_takeovers": len(lengths),
        "takeover_steps": lengths,
        "n_switches": int((np.diff(in_control.astype(int)) != 0).sum()),
        "autonomy": round(1 - float(in_control.mean()), 4),
        "person_seconds": round(spent / fps, 2),
    }


@dataclass
class Totals:
    """What all attempts of a run cost so far.

    Attributes:
        attempts, steps: Made in all.
        expert_steps: For which the expert said what to do.
        controlled_steps: In which it acted.
        takeovers, switches: Of control.
        person_seconds: Of a person's time.
    """

    attempts: int = 0
    steps: int = 0
    expert_steps: int = 0
    controlled_steps: int = 0
    takeovers: int = 0
    switches: int = 0
    person_seconds: float = 0.0

    @classmethod
    def of(cls, lines: Iterable[Mapping[str, Any]]) -> "Totals":
        """Those of the lines of `metrics.jsonl` that are attempts; other lines do not matter."""
        totals = cls()
        for line in lines:
            totals.add(line)
        return totals

    def add(self, line: Mapping[str, Any]) -> None:
        """Counts one more line. One of an older version says the expert's steps only by their share."""
        if line.get("kind") != "attempt":
            return
        n_frames = int(line["n_frames"])
        by_share = round(float(line["intervention_share"]) * n_frames)
        self.attempts += 1
        self.steps += n_frames + int(line.get("n_tried_steps", 0))
        self.expert_steps += int(line.get("n_expert_steps", by_share))
        self.controlled_steps += sum(line["takeover_steps"]) if "takeover_steps" in line else by_share
        self.takeovers += int(line.get("n_takeovers", 0))
        self.switches += int(line.get("n_switches", 0))
        self.person_seconds = round(self.person_seconds + float(line.get("person_seconds", 0.0)), 2)

    @property
    def autonomy(self) -> float:
        """Share of the steps in which the policy acted; 1 before the first."""
        return 1 - self.controlled_steps / self.steps if self.steps else 1.0

    @property
    def mean_takeover_steps(self) -> float:
        """Steps of a takeover, on average; 0 without one."""
        return self.controlled_steps / self.takeovers if self.takeovers else 0.0


def round_figures(lines: Sequence[Mapping[str, Any]], number: int) -> dict[str, Any]:
    """What is said of a round: what the expert spent in the run so far, and in this round's attempts.

    Args:
        lines: The lines of `metrics.jsonl`.
        number: Of the round, counted from 1. Its attempts stand in lines that count the rounds before.
    """
    totals = Totals.of(lines)
    own = Totals.of(line for line in lines if line.get("round") == number - 1)
    return {
        "expert_steps": totals.expert_steps,
        "takeovers": totals.takeovers,
        "switches": totals.switches,
        "person_seconds": totals.person_seconds,
        "autonomy": round(own.autonomy, 4),
        "mean_takeover_steps": round(own.mean_takeover_steps, 2),
    }


def steps_until(lines: Iterable[Mapping[str, Any]], success: float) -> int | None:
    """Steps that the expert had spent when an evaluation first gave at least this success; None if none did.

    Args:
        lines: The lines of `metrics.jsonl`.
        success: [%]
    """
    found = [line for line in lines if line.get("kind") == "eval" and "expert_steps" in line]
    return next((int(line["expert_steps"]) for line in found if line["pc_success"] >= success), None)
