"""Who corrects a policy: the protocol between HG-DAgger and an expert, and the script that comes with an environment.

An expert for another environment is a subclass of `Expert` with three methods and a configuration that makes it, registered
under a name for `--expert.type` (`examples/own_expert.py`).
"""

import abc
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import draccus
import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.play import Observation, Verdict
from lerobot_playbyear.episodes.pool import Script

_SCRIPTS = ("intervention_gate", "scripted_expert")


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

    Attributes:
        person: Imitate a person: react late, tremble, and now and then take over without need.
        reaction_s: Delay before the expert reacts to a mistake, to a call, or to the end of a mistake [s].
        tremor: Standard deviation of the error of the hand's displacements, in units of actions. The last number of an action,
            the gripper's, has none.
        tremor_s: Time in which that error changes [s].
        wrong_per_minute: Needless takeovers per minute in which the policy acts.
        wrong_s: Duration of a needless takeover [s].
        seed: Seed of the imitated person. It gives the same behaviour in the same episode.
    """

    person: bool = False
    reaction_s: float = 0.3
    tremor: float = 0.02
    tremor_s: float = 0.2
    wrong_per_minute: float = 1.0
    wrong_s: float = 1.0
    seed: int = 0

    def make(self, env: gym.Env) -> Expert:
        scripts = [name for name in _SCRIPTS if callable(getattr(env.unwrapped, name, None))]
        if not scripts or (self.person and _SCRIPTS[0] not in scripts):
            raise ExpertError(
                f"--expert.type=scripted{' --expert.person=true' if self.person else ''} needs an environment with "
                f"`intervention_gate()`, and {type(env.unwrapped).__name__} has none. Give another --expert.type, or write an "
                "expert (examples/own_expert.py)."
            )
        if not self.person:
            for name in (each.name for each in fields(self) if getattr(self, each.name) != each.default):
                raise InputError(
                    f"--expert.{name}={getattr(self, name)} imitates a person: give --expert.person=true, or leave it out."
                )
            return ScriptedExpert() if _SCRIPTS[0] in scripts else ScriptedDemonstrator()
        for name in ("reaction_s", "tremor", "tremor_s", "wrong_per_minute", "wrong_s", "seed"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"--expert.{name}={getattr(self, name)}: give 0 or more.")
        return ScriptedPerson(self, float(env.metadata.get("render_fps") or 0))


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
        self._tell_gate("take_over")

    def _tell_gate(self, what: str, *args: bool) -> None:
        """Gates that look at the present state need not be told who acts, and have no such method."""
        getattr(self._gate, what, lambda *_: None)(*args)


class ScriptedDemonstrator(Expert):
    """Shows the scenes that it is told to, from their first step on; in the middle its script would not know what to do."""

    judges = False

    def __init__(self) -> None:
        self._script = Script()

    def reset(self, env: gym.Env) -> None:
        self._script.reset(env)
        self._acts = False

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        self._observation = observation
        return self._acts

    def act(self) -> np.ndarray:
        return np.asarray(self._script.act(self._observation), np.float32)

    def take_over(self) -> None:
        self._acts = True


class ScriptedPerson(ScriptedExpert):
    """The same as a person: sees a mistake, a call and their end `reaction_s` later, trembles, and is wrong now and then.

    Args:
        config: How much of each.
        fps: Steps per second of the environment.

    Raises:
        ExpertError: The environment does not say its steps per second.
    """

    decides = True

    def __init__(self, config: ScriptedExpertConfig, fps: float) -> None:
        if not fps > 0:
            raise ExpertError("--expert.person=true needs the environment's steps per second, metadata['render_fps'].")
        self._config, self.clock_fps = config, fps
        self._n_late = round(config.reaction_s * fps)
        self._n_wrong = round(config.wrong_s * fps)

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        attempt = max(int(env.unwrapped.np_random_seed or 0), 0)
        self._rng = np.random.default_rng([self._config.seed, attempt])
        self._called: bool | None = None
        self._wishes: list[bool] = []
        self._wrong_left, self._acts, self._is_held = 0, False, False
        self._error: np.ndarray | None = None

    def call(self, is_called: bool) -> None:
        self._called = is_called

    def take_over(self) -> None:
        super().take_over()
        self._acts = self._is_held = True

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        seen = super().wants_control(observation, policy_action)
        needs = seen and self._wrong_left == 0  # who took over without need sees none because of that
        self._wishes.append(needs if self._called is None else self._called)
        wishes = self._wishes[-1 - self._n_late] if len(self._wishes) > self._n_late else False
        is_wrong = self._is_wrong(wishes)
        acts = wishes or is_wrong or self._is_held
        if acts and not self._acts:
            self._tell_gate("take_over", self._called is not None or not wishes)
        elif self._acts and not acts:
            self._tell_gate("hand_back")
        self._acts = acts
        return acts

    def act(self) -> np.ndarray:
        return self._by_hand(super().act())

    def _is_wrong(self, is_needed: bool) -> bool:
        """Whether it acts although nothing is wrong. A chance is drawn in every step, so that none depends on another."""
        chance = self._rng.random() * 60 * float(self.clock_fps or 0)
        if self._wrong_left:
            self._wrong_left -= 1
        elif not (is_needed or self._acts) and chance < self._config.wrong_per_minute:
            self._wrong_left = self._n_wrong
        return self._wrong_left > 0

    def _by_hand(self, action: np.ndarray) -> np.ndarray:
        """An action (n,) as an unsteady hand makes it: with noise that changes over `tremor_s` and is as large at all times."""
        n = len(action) - 1
        kept = float(np.exp(-1 / max(self._config.tremor_s * float(self.clock_fps or 0), 1e-6)))
        fresh = self._rng.normal(0.0, self._config.tremor, n)
        self._error = fresh if self._error is None else kept * self._error + np.sqrt(1 - kept**2) * fresh
        return np.append(action[:-1] + self._error, action[-1:]).astype(np.float32)
