"""Scripts that come with an environment, as actors."""

from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_playbyear.episodes.environment import RolloutError
from lerobot_playbyear.episodes.episode import Observation


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
                raise RolloutError(
                    f"{type(owner).__name__} has no scripted expert: recording by script needs `scripted_expert()`."
                )
            self._script = owner.scripted_expert()
            return
        baselines = owner.blind_baselines() if hasattr(owner, "blind_baselines") else {}
        if self._baseline not in baselines:
            raise RolloutError(
                f"There is no blind baseline {self._baseline!r}; there are: {', '.join(baselines) or 'none'}."
            )
        self._script = baselines[self._baseline]

    def act(self, observation: Observation) -> np.ndarray:
        """The script's next action; it knows the environment's state and needs no observation."""
        return self._script.act()
