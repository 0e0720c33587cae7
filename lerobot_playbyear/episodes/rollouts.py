"""Rolling a scripted expert out in one process or in several, with the same result.

This module imports neither LeRobot nor torch, so that a worker process starts in seconds.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import connection
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

Observation = dict[str, Any]


class RolloutError(RuntimeError):
    """The environment cannot be rolled out; the message says why."""


class Actor(Protocol):
    """Whatever chooses the actions of one episode, such as what `env.unwrapped.scripted_expert()` returns."""

    def act(self) -> np.ndarray:
        """The next action, in the environment's action space."""
        ...


@dataclass(frozen=True)
class EnvSpec:
    """How to make an environment: what `gymnasium.make` is given.

    Args:
        id: Its id, with the package that registers it: `package:namespace/Name-v0`.
        kwargs: Its arguments.
    """

    id: str
    kwargs: dict[str, Any] = field(default_factory=dict)

    def make(self) -> gym.Env:
        """Makes the environment and resets it once, so that whatever is missing shows now.

        Raises:
            RolloutError: It cannot be made: not installed, a wrong argument, no OpenGL library.
        """
        try:
            env = gym.make(self.id, disable_env_checker=True, **self.kwargs)
            env.reset(seed=0)
        except Exception as error:
            raise RolloutError(f"{self.id} does not start: {error}") from error
        return env


@dataclass(frozen=True)
class EnvFacts:
    """What a dataset needs to know about an environment before its first episode."""

    observation_space: gym.spaces.Dict
    action_space: gym.spaces.Box
    fps: int
    has_expert: bool


@dataclass
class Episode:
    """One episode of T steps: observations and actions of frame t belong together, the rest is what followed.

    Args:
        seed: What the environment was reset with.
        task: What was to be done, in words.
        observations: T + 1 raw observations, the last one after the last action.
        actions: (T, action dim) float32.
        rewards: (T,) float32.
        successes: (T,) bool, `info["is_success"]` after each action.
        pictures: T + 1 pictures (H, W, 3) uint8 from `env.render()` if they were asked for, otherwise none.
        interventions: (T,) bool, whether an expert chose the action; None stands for all of them.
    """

    seed: int
    task: str
    observations: list[Observation]
    actions: np.ndarray
    rewards: np.ndarray
    successes: np.ndarray
    pictures: list[np.ndarray] = field(default_factory=list)
    interventions: np.ndarray | None = None

    @property
    def success(self) -> bool:
        """Whether the task was solved when the episode ended."""
        return bool(self.successes[-1])

    def __len__(self) -> int:
        return len(self.actions)


def env_facts(env: gym.Env) -> EnvFacts:
    """Reads off an environment what a dataset of it looks like.

    Raises:
        RolloutError: Its observation or action space is not of the kind that LeRobot's datasets hold.
    """
    if not isinstance(env.observation_space, gym.spaces.Dict):
        raise RolloutError(f"The observation space must be a Dict, but it is {env.observation_space}.")
    if not isinstance(env.action_space, gym.spaces.Box):
        raise RolloutError(f"The action space must be a Box, but it is {env.action_space}.")
    return EnvFacts(
        observation_space=env.observation_space,
        action_space=env.action_space,
        fps=int(env.metadata.get("render_fps", 0)),
        has_expert=callable(getattr(env.unwrapped, "scripted_expert", None)),
    )


def roll_out(env: gym.Env, seed: int, *, actor: str | None = None, pictures: bool = False) -> Episode:
    """Plays one episode with a script that comes with the environment.

    Args:
        env: An environment whose unwrapped self has `scripted_expert()` and, for `actor`, `blind_baselines()`.
        seed: For `env.reset`.
        actor: Name of a blind baseline. None: the expert.
        pictures: Whether to keep what `env.render()` shows.

    Raises:
        RolloutError: The environment has no such script.
    """
    observation, _ = env.reset(seed=seed)
    script = _make_actor(env, actor)
    space = env.action_space
    observations, actions, rewards, successes = [observation], [], [], []
    shown = [env.render()] if pictures else []
    ended = False
    while not ended:
        action = np.clip(np.asarray(script.act(), np.float32), space.low, space.high)  # type: ignore[attr-defined]
        observation, reward, terminated, truncated, info = env.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(float(reward))
        successes.append(bool(info["is_success"]))
        if pictures:
            shown.append(env.render())
        ended = terminated or truncated
    return Episode(
        seed=seed,
        task=str(getattr(env.unwrapped, "task_description", "")),
        observations=observations,
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        successes=np.asarray(successes, bool),
        pictures=shown,  # type: ignore[arg-type]
    )


def _make_actor(env: gym.Env, name: str | None) -> Actor:
    owner: Any = env.unwrapped
    if name is not None:
        baselines = owner.blind_baselines() if hasattr(owner, "blind_baselines") else {}
        if name not in baselines:
            raise RolloutError(f"There is no blind baseline {name!r}; there are: {', '.join(baselines) or 'none'}.")
        return baselines[name]
    if not callable(getattr(owner, "scripted_expert", None)):
        raise RolloutError(
            f"{type(owner).__name__} has no scripted expert: recording by script needs `scripted_expert()`."
        )
    return owner.scripted_expert()


class RolloutPool:
    """Makes environments and rolls them out, in this process or in worker processes.

    Episodes come in the order of their seeds and do not depend on the number of workers.

    Args:
        spec: The environment.
        num_workers: Processes; 0 rolls out in this one. Workers start afresh, so a script that uses this class needs
            an `if __name__ == "__main__":` guard.
    """

    def __init__(self, spec: EnvSpec, num_workers: int = 0):
        if num_workers < 0:
            raise ValueError(f"num_workers={num_workers}: give 0 for none, or how many processes.")
        self._spec, self._num_workers = spec, num_workers
        self._env: gym.Env | None = None
        self._executor: ProcessPoolExecutor | None = None
        if num_workers:
            context = multiprocessing.get_context("spawn")
            self._lifeline, self._workers_end = context.Pipe()  # workers exit when our end is closed, or dies with us
            self._executor = ProcessPoolExecutor(
                num_workers,
                mp_context=context,
                initializer=_start_worker,
                initargs=(spec, self._workers_end),
            )

    def facts(self) -> EnvFacts:
        """What the environment looks like.

        Raises:
            RolloutError: It cannot be made, or is not of the kind that datasets hold.
        """
        return self._result(self._executor.submit(_facts_in_worker)) if self._executor else env_facts(self._own_env())

    def episodes(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """Expert episodes, one per seed and in their order; works ahead of the caller by two per worker.

        Raises:
            RolloutError: A worker died, or the environment has no expert.
        """
        if self._executor is None:
            for seed in seeds:
                yield roll_out(self._own_env(), seed)
            return
        upcoming = iter(seeds)
        pending: deque[Future] = deque()
        while True:
            while len(pending) < 2 * self._num_workers:
                try:
                    pending.append(self._executor.submit(_roll_out_in_worker, next(upcoming)))
                except StopIteration:
                    break
            if not pending:
                return
            yield self._result(pending.popleft())

    def close(self) -> None:
        """Ends the workers, without waiting for what they are doing."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)
            self._lifeline.close()
            self._executor.shutdown(wait=True)
            self._workers_end.close()
            self._executor = None
        if self._env is not None:
            self._env.close()
            self._env = None

    def __enter__(self) -> "RolloutPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _own_env(self) -> gym.Env:
        if self._env is None:
            self._env = self._spec.make()
        return self._env

    @staticmethod
    def _result(future: Future) -> Any:
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise RolloutError(
                "A rollout worker died (out of memory, or killed). Try fewer: num_workers=1, or 0 for none."
            ) from error


# What follows runs in a worker; the environment there is the worker's own and lives as long as it does.
_worker_spec: EnvSpec | None = None
_worker_env: gym.Env | None = None


def _start_worker(spec: EnvSpec, lifeline: connection.Connection) -> None:
    global _worker_spec
    _worker_spec = spec
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends the workers
    threading.Thread(target=_exit_with_parent, args=(lifeline,), daemon=True).start()


def _exit_with_parent(lifeline: connection.Connection) -> None:
    connection.wait([lifeline])
    os._exit(0)


def _env_of_worker() -> gym.Env:
    global _worker_env
    if _worker_env is None:
        assert _worker_spec is not None
        _worker_env = _worker_spec.make()
    return _worker_env


def _facts_in_worker() -> EnvFacts:
    return env_facts(_env_of_worker())


def _roll_out_in_worker(seed: int) -> Episode:
    return roll_out(_env_of_worker(), seed)
