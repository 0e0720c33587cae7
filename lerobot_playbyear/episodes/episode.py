"""What an episode is, once it was played."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

Observation = dict[str, Any]


class Verdict(Enum):
    """How an expert ends an episode before the environment does.

    SUCCESS, FAILURE: It counts as solved, or as not. DISCARD: It counts for nothing; the next one begins.
    """

    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"


@dataclass
class Episode:
    """One episode of T steps: observations and actions of frame t belong together, the rest is what followed.

    Args:
        seed: What the environment was reset with.
        task: What was to be done, in words.
        observations: T + 1 raw observations, the last one after the last action.
        actions: (T, action dim) float32.
        rewards: (T,) float32.
        successes: (T,) bool, `info["is_success"]` after each action, or what the expert's verdict says.
        interventions: (T,) bool, whether the expert beside the actor chose the action; None if nobody was beside it.
        verdict: How the expert ended it, if so.
        executed: (T, action dim) what was done, where `actions` are an expert's labels of what the policy met; else None.
        watched: T + 1 values of what `play` was asked to watch, such as pictures; otherwise none.
    """

    seed: int
    task: str
    observations: list[Observation]
    actions: np.ndarray
    rewards: np.ndarray
    successes: np.ndarray
    interventions: np.ndarray | None = None
    verdict: Verdict | None = None
    watched: list[Any] = field(default_factory=list)
    executed: np.ndarray | None = None

    @property
    def success(self) -> bool:
        """Whether the task was solved when the episode ended."""
        return bool(self.successes[-1])

    @property
    def intervention_share(self) -> float:
        """Share of the steps in which an expert beside the actor chose the action."""
        return 0.0 if self.interventions is None else float(self.interventions.mean())

    def __len__(self) -> int:
        return len(self.actions)
