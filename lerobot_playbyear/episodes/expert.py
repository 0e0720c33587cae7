"""Who corrects a policy: the protocol between HG-DAgger and an expert, and the scripted one that comes with an environment.

An expert for another environment is a subclass of `Expert` with three methods and a configuration that makes it, registered
under a name for `--expert.type` (`examples/own_expert.py`).
"""

import abc
from dataclasses import dataclass
from typing import Any

import draccus
import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.episode import Observation, Verdict


class ExpertError(InputError):
    """The environment and the expert do not go together; the message says what is missing."""


class Expert(abc.ABC):
    """Watches a policy at work and takes over.

    In each step `wants_control` is called once with what the policy would do, then `act` if it returned True, then the
    environment steps, then `verdict`. A step may take as long as the expert likes: a person's expert keeps the pace and
    shows a window in `wants_control`.
    """

    @abc.abstractmethod
    def reset(self, env: gym.Env) -> None:
        """A new episode has begun.

        Args:
            env: The environment, reset. It is the same object in all episodes; `env.unwrapped` is the task itself.
        """

    @abc.abstractmethod
    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        """Whether the expert, and not the policy, chooses this step's action.

        Args:
            observation: The environment's, as `env.step` returned it.
            policy_action: (action dim,) what the policy would do.
        """

    @abc.abstractmethod
    def act(self) -> np.ndarray:
        """The expert's action (action dim,) for this step."""

    def verdict(self) -> Verdict | None:
        """Whether the attempt ends now; None goes on. Asked after every step."""
        return None

    def close(self) -> None:  # noqa: B027 (most experts have nothing to close)
        """No episode follows."""


@dataclass
class ExpertConfig(draccus.ChoiceRegistry, abc.ABC):
    """Options of an expert, `--expert.*`. Subclasses register with `@ExpertConfig.register_subclass("name")`."""

    @property
    def type(self) -> str:
        return str(self.get_choice_name(self.__class__))

    @classmethod
    def default_choice_name(cls) -> str | None:
        return "scripted"

    @abc.abstractmethod
    def make(self, env: gym.Env) -> Expert:
        """Makes the expert.

        Args:
            env: The environment that all episodes happen in.

        Raises:
            ExpertError: It does not go with this environment.
        """


@ExpertConfig.register_subclass("scripted")
@dataclass
class ScriptedExpertConfig(ExpertConfig):
    """The script that comes with the environment, `env.unwrapped.intervention_gate()`."""

    def make(self, env: gym.Env) -> Expert:
        if not callable(getattr(env.unwrapped, "intervention_gate", None)):
            raise ExpertError(
                f"--expert.type=scripted needs an environment with `intervention_gate()`, and "
                f"{type(env.unwrapped).__name__} has none. Give another --expert.type, or write an expert "
                "(examples/own_expert.py)."
            )
        return ScriptedExpert()


class ScriptedExpert(Expert):
    """Lets the environment's gate decide and the environment's script act."""

    def reset(self, env: gym.Env) -> None:
        task_env: Any = env.unwrapped
        self._gate = task_env.intervention_gate()

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        return bool(self._gate.wants_control(policy_action))

    def act(self) -> np.ndarray:
        return np.asarray(self._gate.act(), np.float32)
