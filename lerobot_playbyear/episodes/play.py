"""What an episode is, and the loop that plays one, whoever acts: a script, a policy, or a policy with an expert beside it.

This module imports neither LeRobot nor torch, so that a process that plays scripts starts in seconds.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium as gym
import numpy as np

from lerobot_playbyear.episodes.environment import task_description

if TYPE_CHECKING:
    from lerobot_playbyear.episodes.experts import Expert


Observation = dict[str, Any]


class Verdict(Enum):
    """How an expert ends an episode before the environment does.

    SUCCESS, FAILURE: It counts as solved, or as not. ENDED: as what the environment says. DISCARD: It counts for nothing.
    """

    SUCCESS = "success"
    FAILURE = "failure"
    ENDED = "ended"
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


class Actor(Protocol):
    """Whoever chooses the actions of an episode, unless an expert does."""

    def reset(self, env: gym.Env) -> None:
        """A new episode has begun; the environment is reset."""

    def act(self, observation: Observation) -> np.ndarray:
        """The next action (action dim,), as the environment takes it. Asked in every step, also if an expert acts."""
        ...


@dataclass
class Seconds:
    """Where time went, by name [s]."""

    spent: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Counts what happens inside."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.spent[name] = self.spent.get(name, 0.0) + time.perf_counter() - start

    def add(self, other: "Seconds") -> None:
        """Counts what another clock has counted."""
        for name, value in other.spent.items():
            self.spent[name] = self.spent.get(name, 0.0) + value


def play(
    env: gym.Env,
    actor: Actor,
    seed: int,
    *,
    expert: "Expert | None" = None,
    options: dict[str, Any] | None = None,
    watch: Callable[[], Any] | None = None,
    seconds: Seconds | None = None,
) -> Episode:
    """Plays one episode until the environment or the expert ends it, or its steps are used up.

    In every step the actor is asked first; an expert who sits beside it then takes over or lets it act. So a policy's
    memory is that of the whole episode. Actions are clipped to the action space.

    Args:
        env: The environment; `info["is_success"]` is there after every step, and `_max_episode_steps`, if it has that,
            limits their number.
        actor: Who acts.
        seed, options: For `env.reset`.
        expert: Who may take over.
        watch: Called after the reset and after every step; what it returns is kept, such as `env.render` pictures.
        seconds: Counts `simulation` (environment and expert) and `inference` (actor).
    """
    seconds = seconds or Seconds()
    with seconds.of("simulation"):
        observation, _ = env.reset(seed=seed, options=options)
        if expert is not None:
            expert.reset(env)
    with seconds.of("inference"):
        actor.reset(env)
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    limit = env.get_wrapper_attr("_max_episode_steps") if env.has_wrapper_attr("_max_episode_steps") else np.inf
    observations = [observation]
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    successes: list[bool] = []
    interventions: list[bool] = []
    watched = [watch()] if watch else []
    verdict, ended = None, False
    while not ended:
        with seconds.of("inference"):
            action = actor.act(observation)
        with seconds.of("simulation"):
            by_expert = expert is not None and bool(expert.wants_control(observation, action))
            if expert is not None and by_expert:
                action = expert.act()
            action = np.asarray(action, np.float32).clip(space.low, space.high)
            observation, reward, terminated, truncated, info = env.step(action)
            verdict = None if expert is None else expert.verdict()
        observations.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        is_open = verdict in (None, Verdict.ENDED)
        successes.append(verdict is Verdict.SUCCESS or (is_open and bool(info["is_success"])))
        interventions.append(by_expert)
        if watch:
            watched.append(watch())
        ended = terminated or truncated or verdict is not None or len(actions) >= limit
    by_step = np.stack(actions), np.asarray(rewards, np.float32), np.asarray(successes, bool)
    corrected = None if expert is None else np.asarray(interventions, bool)
    return Episode(seed, task_description(env), observations, *by_step, corrected, verdict, watched)
