"""Scripts that come with an environment, and episodes of its expert, played in this process or in several.

This module imports neither LeRobot nor torch, so that a worker process starts in seconds.
"""

import itertools
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.environment import EnvFacts, EnvSpec, RolloutError, env_facts
from lerobot_playbyear.episodes.play import Episode, Observation, play


class Script:
    """The environment's expert, `env.unwrapped.scripted_expert()`, or one of its `blind_baselines()`.

    Args:
        baseline: Name of a blind baseline. None: the expert.
    """

    def __init__(self, baseline: str | None = None) -> None:
        self._baseline = baseline

    def reset(self, env: gym.Env) -> None:
        """Asks the environment for a script for this episode.

        Raises:
            RolloutError: It has no such script.
        """
        owner: Any = env.unwrapped
        if self._baseline is None:
            if not callable(getattr(owner, "scripted_expert", None)):
                raise RolloutError(f"{type(owner).__name__} has no scripted expert: it lacks `scripted_expert()`.")
            self._script = owner.scripted_expert()
            return
        baselines = owner.blind_baselines() if hasattr(owner, "blind_baselines") else {}
        if self._baseline not in baselines:
            raise RolloutError(f"There is no blind baseline {self._baseline!r}, only {', '.join(baselines) or 'none'}.")
        self._script = baselines[self._baseline]

    def act(self, observation: Observation) -> np.ndarray:
        """The script's next action; it knows the environment's state and needs no observation."""
        return self._script.act()


class RolloutPool:
    """Makes environments and lets their expert play, in this process or in worker processes.

    Episodes come in the order of their seeds and do not depend on the number of workers.

    Args:
        spec: The environment.
        num_workers: Processes; 0 plays in this one. Workers start afresh, so a script that uses this class needs
            an `if __name__ == "__main__":` guard.
    """

    def __init__(self, spec: EnvSpec, num_workers: int = 0):
        if num_workers < 0:
            raise InputError(f"num_workers={num_workers}: give 0 for none, or how many processes.")
        self._spec, self._num_workers = spec, num_workers
        self._env: gym.Env | None = None
        self._executor: ProcessPoolExecutor | None = None
        if num_workers:
            context = multiprocessing.get_context("spawn")
            self._lifeline, self._workers_end = context.Pipe()  # workers stop when our end is closed, or dies with us
            self._executor = ProcessPoolExecutor(num_workers, context, _start_worker, (spec, self._workers_end))

    def facts(self) -> EnvFacts:
        """What the environment looks like.

        Raises:
            RolloutError: It cannot be made, or is not of the kind that datasets hold.
        """
        return self._result(self._executor.submit(_facts_in_worker)) if self._executor else env_facts(self.own_env())

    def episodes(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """Expert episodes, one per seed and in their order; works ahead of the caller by two per worker.

        Raises:
            RolloutError: A worker died, or the environment has no expert.
        """
        executor = self._executor
        if executor is None:
            for seed in seeds:
                yield play(self.own_env(), Script(), seed)
            return
        futures = (executor.submit(_play_in_worker, seed) for seed in seeds)
        pending = deque(itertools.islice(futures, 2 * self._num_workers))
        while pending:
            yield self._result(pending.popleft())
            pending.extend(itertools.islice(futures, 1))

    def close(self) -> None:
        """Ends the workers; what they are doing is given up at its next step."""
        if self._executor is not None:
            self._lifeline.close()
            self._executor.shutdown(wait=True, cancel_futures=True)
            self._workers_end.close()
            self._executor = None
        if self._env is not None:
            self._env.close()
            self._env = None

    def own_env(self) -> gym.Env:
        """The environment of this process."""
        if self._env is None:
            self._env = self._spec.make()
        return self._env

    @staticmethod
    def _result(future: Future) -> Any:
        try:
            return future.result()
        except BrokenProcessPool as error:
            said = "A rollout worker died (out of memory, or killed). Try fewer: num_workers=1, or 0 for none."
            raise RolloutError(said) from error


# What follows runs in a worker; the environment there is the worker's own and lives as long as it does.
_own_pool: RolloutPool
_is_to_stop = threading.Event()
_GRACE = 30.0  # seconds for a step of the environment


class _StoppedError(Exception):
    """Nobody wants the episode any more."""


class _StoppableScript(Script):
    def act(self, observation: Observation) -> np.ndarray:
        if _is_to_stop.is_set():
            raise _StoppedError
        return super().act(observation)


def _start_worker(spec: EnvSpec, lifeline: connection.Connection) -> None:
    global _own_pool
    _own_pool = RolloutPool(spec)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends the workers
    threading.Thread(target=_stop_with_parent, args=(lifeline,), daemon=True).start()


def _stop_with_parent(lifeline: connection.Connection) -> None:
    connection.wait([lifeline])
    # No exit yet: of a result that is sent in part, the parent would wait for the rest for ever.
    _is_to_stop.set()
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel], timeout=_GRACE)
    os._exit(0)


def _facts_in_worker() -> EnvFacts:
    return _own_pool.facts()


def _play_in_worker(seed: int) -> Episode:
    return play(_own_pool.own_env(), _StoppableScript(), seed)
