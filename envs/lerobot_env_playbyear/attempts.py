"""How every attempt ended, in a file: LeRobot's evaluations keep successes alone."""

import json
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
    `is_success`, `end`, `acted_early` and `n_closings` where the task tells them, and what the task kept secret. Attempts
    that are broken off leave none. Several environments, also in processes of their own, may share a file.

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

    @classmethod
    def around(cls, make: Callable[[], gym.Env], path: str) -> "AttemptsFile":
        """The environment that `make` makes, with its file."""
        return cls(make(), path)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self._seed, self._n_steps, self._is_over = seed, 0, False
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        outcome = self.env.step(action)
        self._n_steps += 1
        _, _, terminated, truncated, info = outcome
        if (terminated or truncated) and not self._is_over:
            self._is_over = True
            values = {key: np.asarray(value) for key, value in info.items()}
            told = {key: value.tolist() for key, value in values.items() if value.dtype.kind in _PLAIN}
            line = json.dumps({"seed": self._seed, "steps": self._n_steps, **told})
            with self._path.open("a") as file:
                file.write(line + "\n")  # one write: lines of several processes do not mix
        return outcome
