"""Rolling a policy out beside an expert who may take over: one attempt per seed, recorded from its first step to its last."""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import EnvConfig, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION

from lerobot_playbyear.episodes.expert import Expert, Verdict
from lerobot_playbyear.episodes.rollouts import Episode, Observation


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


@dataclass
class Attempt:
    """One episode of a policy with an expert beside it.

    Attributes:
        episode: What happened, from the first step to the last; `interventions` says who acted.
        verdict: How the expert ended it, if so.
    """

    episode: Episode
    verdict: Verdict | None = None

    @property
    def intervention_share(self) -> float:
        """Share of the steps in which the expert acted."""
        return 0.0 if self.episode.interventions is None else float(self.episode.interventions.mean())

    @property
    def is_kept(self) -> bool:
        """Whether it is learned from: it succeeded, and the expert acted at least once."""
        return self.verdict is not Verdict.DISCARD and self.episode.success and self.intervention_share > 0


class Learner(Protocol):
    """Whoever acts while the expert does not."""

    def reset(self) -> None:
        """An episode begins."""

    def act(self, observation: Observation, task: str) -> np.ndarray:
        """An action (action dim,), as the environment takes it."""
        ...


class PolicyActor:
    """A policy as it acts in lerobot-eval, one environment at a time.

    Args:
        policy: The policy; it is reset at each episode's start.
        env_cfg: The environment's configuration, which knows the processors between both.
        preprocessor, postprocessor: The policy's own.
        autocast: Makes the context of the policy's precision.
    """

    def __init__(
        self,
        policy: PreTrainedPolicy,
        env_cfg: EnvConfig,
        preprocessor: PolicyProcessorPipeline,
        postprocessor: PolicyProcessorPipeline,
        autocast: Callable[[], AbstractContextManager] = nullcontext,
    ) -> None:
        self._policy, self._autocast = policy, autocast
        self._preprocessor, self._postprocessor = preprocessor, postprocessor
        self._env_preprocessor, self._env_postprocessor = make_env_pre_post_processors(
            env_cfg=env_cfg, policy_cfg=policy.config
        )

    def reset(self) -> None:
        """An episode begins."""
        self._policy.eval()
        self._policy.reset()

    @torch.no_grad()
    def act(self, observation: Observation, task: str) -> np.ndarray:
        """The policy's action (action dim,), as the environment takes it."""
        batch: dict[str, Any] = preprocess_observation(_as_batch(observation))
        batch["task"] = [task]
        with self._autocast():
            action = self._policy.select_action(self._preprocessor(self._env_preprocessor(batch)))
        action = self._env_postprocessor({ACTION: self._postprocessor(action)})[ACTION]
        return action.to("cpu", torch.float32).numpy()[0]


def collect(env: gym.Env, actor: Learner, expert: Expert, seed: int, seconds: Seconds | None = None) -> Attempt:
    """Plays one episode: in every step the expert is asked, and either acts or lets the policy act.

    The policy sees every step, also those in which the expert acts, so that its memory is that of the whole episode.

    Args:
        env: The environment, with LeRobot's contract (`info["is_success"]`, `task_description`, `_max_episode_steps`).
        actor: The policy.
        expert: Who corrects it.
        seed: For `env.reset`.
        seconds: Counts `simulation` (environment and expert) and `inference` (policy).
    """
    seconds = seconds or Seconds()
    with seconds.of("simulation"):
        observation, _ = env.reset(seed=seed)
        expert.reset(env)
    with seconds.of("inference"):
        actor.reset()
    task, limit, space = _task(env), env.get_wrapper_attr("_max_episode_steps"), env.action_space
    assert isinstance(space, gym.spaces.Box)
    observations, actions, rewards, successes, interventions = [observation], [], [], [], []
    verdict, ended = None, False
    while not ended:
        with seconds.of("inference"):
            action = actor.act(observation, task)
        with seconds.of("simulation"):
            by_expert = bool(expert.wants_control(observation, action))
            action = np.asarray(expert.act() if by_expert else action, np.float32).clip(space.low, space.high)
            observation, reward, terminated, truncated, info = env.step(action)
            verdict = expert.verdict()
        observations.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        successes.append(verdict is Verdict.SUCCESS or (verdict is None and bool(info["is_success"])))
        interventions.append(by_expert)
        ended = terminated or truncated or verdict is not None or len(actions) >= limit
    episode = Episode(
        seed=seed,
        task=task,
        observations=observations,
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        successes=np.asarray(successes, bool),
        interventions=np.asarray(interventions, bool),
    )
    return Attempt(episode, verdict)


def _as_batch(observation: Observation) -> Observation:
    """A raw observation as a batch of one."""
    return {
        key: _as_batch(value) if isinstance(value, dict) else np.asarray(value)[None]
        for key, value in observation.items()
    }


def _task(env: gym.Env) -> str:
    for name in ("task_description", "task"):
        if env.has_wrapper_attr(name):
            return str(env.get_wrapper_attr(name))
    return ""
