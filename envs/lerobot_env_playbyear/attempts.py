"""How every attempt ended: LeRobot's evaluations keep successes alone."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

_MOST_BYTES = 2**16  # of a line
_PLAIN = "biufU"  # NumPy's kinds of truth values, numbers and texts: what JSON has, too


def holds_attempts(path: Path) -> bool:
    """Whether attempts may be appended to a file, which a stranger's options may name: it holds some, or nothing."""
    if not path.exists():
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        line = file.readline(_MOST_BYTES)
    try:
        return not line or "steps" in dict(json.loads(line))
    except (ValueError, TypeError, RecursionError):
        return False


class AttemptsFile(gym.Wrapper):
    """Appends one line of JSON to a file at the end of every attempt.

    A line has `seed` (null where the environment drew it), `steps`, and what the environment's `info` says at the end:
    `is_success`, `end`, `acted_early` and `n_closings` where the task tells them, and what the task kept secret. Of a failure
    in one of our tasks it has `failure`, its mode (`gym_playbyear.failures`). Attempts that are broken off leave none.
    Several environments, also in processes of their own, may share a file.

    Args:
        env: The environment.
        path: The file; its folder is made.
    """

    def __init__(self, env: gym.Env, path: str):
        super().__init__(env)
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._seed: int | None = None
        self._n_steps, self._is_over = 0, False
        self._mode: Any = None

    @classmethod
    def around(cls, make: Callable[[], gym.Env], path: str) -> "AttemptsFile":
        """The environment that `make` makes, with its file."""
        return cls(make(), path)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self._seed, self._n_steps, self._is_over = seed, 0, False
        observed = self.env.reset(seed=seed, options=options)
        self._mode = _failure_mode(self.unwrapped)
        return observed

    def step(self, action):
        outcome = self.env.step(action)
        self._n_steps += 1
        _, _, terminated, truncated, info = outcome
        if self._mode is not None:
            self._mode.look(self.unwrapped)
        if (terminated or truncated) and not self._is_over:
            self._is_over = True
            values = {key: np.asarray(value) for key, value in info.items()}
            told = {key: value.tolist() for key, value in values.items() if value.dtype.kind in _PLAIN}
            if self._mode is not None and not info["is_success"]:
                told["failure"] = self._mode.told(self.unwrapped, info["end"])
            line = json.dumps({"seed": self._seed, "steps": self._n_steps, **told})
            with self._path.open("a") as file:
                file.write(line + "\n")  # one write: lines of several processes do not mix
        return outcome


def _failure_mode(env: gym.Env) -> Any:
    """What watches an attempt at one of our tasks. They are imported when one is there, as in `config.py`."""
    from gym_playbyear.environment import TaskEnv
    from gym_playbyear.failures import FailureMode

    return FailureMode(env) if isinstance(env, TaskEnv) else None


class _AsksWhoHeard(gym.vector.VectorEnv):
    """Remembers of every episode whether the hand acted before anything was heard, and logs their share at the end.

    Attributes:
        acted_early: Of every episode that was begun, in the order of LeRobot's evaluations; None where it is not over, or
            where the task does not tell.
    """

    acted_early: tuple[bool | None, ...] = ()

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None):
        self.acted_early += (None,) * self.num_envs
        return super().reset(seed=seed, options=options)  # type: ignore[arg-type]  # a list for each environment

    def step(self, actions):
        outcome = super().step(actions)
        ended = outcome[-1].get("final_info", {})  # an episode that is over says so at every further step, too
        if "acted_early" in ended:
            before, now = self.acted_early[: -self.num_envs], self.acted_early[-self.num_envs :]
            told = zip(now, ended["_acted_early"], ended["acted_early"], strict=True)
            self.acted_early = before + tuple(bool(early) if is_over else known for known, is_over, early in told)
        return outcome

    def close_extras(self, **kwargs: Any) -> None:
        told = [early for early in self.acted_early if early is not None]
        if told:
            logging.info(f"Acted before anything was heard: {sum(told) / len(told):.1%} of {len(told)} episodes")
        super().close_extras(**kwargs)


class SyncVectorEnv(_AsksWhoHeard, gym.vector.SyncVectorEnv):
    """Environments in this process."""


class AsyncVectorEnv(_AsksWhoHeard, gym.vector.AsyncVectorEnv):  # type: ignore[misc]
    """Environments in a process each."""
