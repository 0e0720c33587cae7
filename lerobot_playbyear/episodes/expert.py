"""Who corrects a policy: the protocol between HG-DAgger and an expert, and the scripted one that comes with an environment.

An expert for another environment is a subclass of `Expert` with three methods and a configuration that makes it, registered
under a name for `--expert.type` (`examples/own_expert.py`).
"""

import abc
from dataclasses import dataclass
from typing import ClassVar

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

    The methods of HG-DAgger (`--method.type`) may ask for more: `take_over` and `hand_back` where somebody else decides who
    acts, `label` where the policy acts all the time, `call` where the robot asks for help.

    Attributes:
        decides: It takes over when it likes, also where the robot asks, as a person does: then it is only called.
        judges: It says by itself when it takes over. Otherwise it only shows whole scenes, `--method.type=redo`.
        can_label: It can say what to do while somebody else acts.
        clock_fps: Steps per second of the person who corrects; None where nobody's time is spent.
    """

    decides: ClassVar[bool] = False
    judges: ClassVar[bool] = True
    can_label: ClassVar[bool] = True
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

    def take_over(self, until_told: bool = True) -> None:  # noqa: B027 (an expert that looks at the present state needs none)
        """Somebody else says that the expert is in control from this step on. Called after `wants_control`, before `act`, or
        after `reset`.

        Args:
            until_told: Until `hand_back`, or the end; otherwise until its `wants_control` says no.
        """

    def hand_back(self) -> None:  # noqa: B027
        """Somebody else says that the policy is in control again."""

    def label(self) -> np.ndarray:
        """The expert's action (action dim,) for this step, in which the policy acts. Called after `wants_control`."""
        return self.act()

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
