"""Who corrects a policy: the protocol between HG-DAgger and an expert, and the script that comes with an environment.

An expert for another environment is a subclass of `Expert` with three methods and a configuration that makes it, registered
under a name for `--expert.type` (`examples/own_expert.py`).
"""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import draccus
import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.play import Observation, Verdict
from lerobot_playbyear.episodes.pool import Script


class ExpertError(InputError):
    """The environment and the expert do not go together; the message says what is missing."""


class Expert(abc.ABC):
    """Watches a policy at work and takes over.

    In each step `wants_control` is called once with what the policy would do, then `act` if it returned True, then the
    environment steps, then `verdict`. A step may take as long as the expert likes: a person's expert keeps the pace and
    shows a window in `wants_control`.

    The methods of HG-DAgger (`--method.type`) may ask for more: `take_over` where somebody else decides who acts, `call` where
    the robot asks for help.

    Attributes:
        decides: It takes over when it likes, also where the robot asks, as a person does: then it is only called.
        judges: It says by itself when it takes over. Otherwise it only shows whole scenes, `--method.type=redo`.
        clock_fps: Steps per second of the person who corrects; None where nobody's time is spent.
    """

    decides: ClassVar[bool] = False
    judges: ClassVar[bool] = True
    clock_fps: float | None = None

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

    def take_over(self) -> None:  # noqa: B027 (an expert that looks at the present state needs none)
        """Somebody else says that the expert is in control from this step on, until the attempt ends. Called after
        `wants_control`, before `act`, or after `reset`."""

    def call(self, is_called: bool) -> None:  # noqa: B027
        """Whether the robot asks for help in this step. Called before `wants_control` of an expert that `decides`."""

    def verdict(self) -> Verdict | None:
        """Whether the attempt ends now; None goes on. Asked after every step, or more often."""
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
    """The script that comes with the environment, `env.unwrapped.intervention_gate()`. Without it the environment's
    `scripted_expert()`, which can only demonstrate whole episodes.
    """

    def make(self, env: gym.Env) -> Expert:
        if callable(getattr(env.unwrapped, "intervention_gate", None)):
            return ScriptedExpert()
        if callable(getattr(env.unwrapped, "scripted_expert", None)):
            return ScriptedDemonstrator()
        raise ExpertError(
            f"--expert.type=scripted needs an environment with `intervention_gate()`, and {type(env.unwrapped).__name__} has "
            "none. Give another --expert.type, or write an expert (examples/own_expert.py)."
        )


class ScriptedExpert(Expert):
    """Lets the environment's gate decide and the environment's script act."""

    def reset(self, env: gym.Env) -> None:
        task_env: Any = env.unwrapped
        self._gate = task_env.intervention_gate()

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        return bool(self._gate.wants_control(policy_action))

    def act(self) -> np.ndarray:
        return np.asarray(self._gate.act(), np.float32)

    def take_over(self) -> None:
        getattr(self._gate, "take_over", lambda: None)()  # gates that look at the present state need not be told


class ScriptedDemonstrator(Expert):
    """Shows the scenes that it is told to, from their first step on; in the middle its script would not know what to do."""

    judges = False

    def reset(self, env: gym.Env) -> None:
        self._script = Script()
        self._script.reset(env)
        self._acts = False

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        self._observation = observation
        return self._acts

    def act(self) -> np.ndarray:
        return np.asarray(self._script.act(self._observation), np.float32)

    def take_over(self) -> None:
        self._acts = True
