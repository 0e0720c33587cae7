"""`--expert.type=startled`"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from lerobot_playbyear.dagger import Expert, ExpertConfig


@ExpertConfig.register_subclass("startled")
@dataclass
class StartledConfig(ExpertConfig):
    """The environment's script, which takes over whenever something is loud.

    Args:
        loud: How loud: the largest sample, 1 at full scale.
        steps: For how many steps.
    """

    loud: float = 0.1
    steps: int = 20

    def make(self, env: gym.Env) -> Expert:
        return Startled(self)


class Startled(Expert):
    """Takes over for a while after every loud sound."""

    def __init__(self, config: StartledConfig):
        self.config = config

    def reset(self, env: gym.Env) -> None:
        self.script, self.n_left = env.unwrapped.scripted_expert(), 0

    def wants_control(self, observation: dict, policy_action: np.ndarray) -> bool:
        peaks = [np.abs(sound / 32768).max() for key, sound in observation.items() if key.startswith("audio.")]
        self.n_left = self.config.steps if max(peaks) > self.config.loud else self.n_left - 1
        return self.n_left > 0

    def act(self) -> np.ndarray:
        return np.asarray(self.script.act(), np.float32)
