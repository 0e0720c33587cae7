"""The simulated tasks for tests: nothing is heard or drawn that nobody asks for, and episodes are played to their end."""

from typing import Any

import gymnasium as gym
import numpy as np

STILL = np.array([0.0, 0.0, 0.0, -1.0])


def make(task: str, **options: Any) -> Any:
    """The environment itself, without Gymnasium's wrappers; as small as may be where the options do not say otherwise."""
    small = {"sound": "none", "image_size": 16, "disable_env_checker": True}
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", **{**small, **options}).unwrapped


class Still:
    """A policy that does nothing."""

    def act(self) -> np.ndarray:
        return STILL


def finish(env: Any, policy: Any, gate: Any = None) -> dict[str, Any]:
    """Plays the physics of an episode to its end; the last step's `info`, and where a gate looks on who acted, `by_expert`."""
    by_expert, over, info = [], False, {}
    while not over:
        action = policy.act()
        by_expert.append(gate is not None and gate.wants_control(action))
        _, terminated, truncated, info = env.step_physics(gate.act() if by_expert[-1] else action)
        over = terminated or truncated
    return info if gate is None else {**info, "by_expert": np.array(by_expert)}
