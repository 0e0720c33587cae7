"""What an episode is, once it was played."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

Observation = dict[str, Any]


class Verdict(Enum):
    """How an expert ends an episode before the environment does.

    SUCCESS, FAILURE: It counts as solved, or as not. DISCARD: It counts for nothing; the next one begins.
    """

    SUCCESS = "success"
    FAILURE = "failure"
    DISCARD = "discard"


class Step(NamedTuple):
    """One step of an episode: what was observed, what was done then, and what came of it.

    Args:
        observation: A raw observation.
        action: (action dim,) float32.
        reward: Of the action.
        success: Whether the task was solved after it.
        by_expert: Whether the expert beside the actor chose it.
        is_last: Whether the episode ended with it.
    """

    observation: Observation
    action: np.ndarray
    reward: float
    success: bool
    by_expert: bool
    is_last: bool


@dataclass
class Episode:
    """One episode of T steps: observations and actions of frame t belong together, the rest is what followed.

    Args:
        seed: What the environment was reset with.
        task: What was to be done, in words.
        observations: T + 1 raw observations, the last one after the last action; none where they went elsewhere as they came.
        actions: (T, action dim) float32.
        rewards: (T,) float32.
        successes: (T,) bool, `info["is_success"]` after each action, or what the expert's verdict says.
        interventions: (T,) bool, whether the expert beside the actor chose the action; None if nobody was beside it.
        verdict: How the expert ended it, if so.
        executed: (T, action dim) what was done, where `actions` are an expert's labels of what the policy met; else None.
        facts: What the environment says about how the episode went, such as drop-outs of its microphones; None if it does not.
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
    facts: dict[str, Any] | None = None
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
