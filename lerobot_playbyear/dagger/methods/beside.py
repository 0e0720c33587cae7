"""Experts that speak for another expert: when it takes over, how long it stays, and what it says where it may not act."""

import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.episodes.episode import Observation, Verdict
from lerobot_playbyear.episodes.expert import Expert, ExpertError


class Beside(Expert):
    """Passes everything on to an expert.

    Args:
        expert: The expert.
    """

    def __init__(self, expert: Expert) -> None:
        self.expert = expert
        self.clock_fps, self.decides = expert.clock_fps, expert.decides  # type: ignore[misc]
        self.can_label = expert.can_label  # type: ignore[misc]

    def reset(self, env: gym.Env) -> None:
        self.expert.reset(env)

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        return self.expert.wants_control(observation, policy_action)

    def act(self) -> np.ndarray:
        return self.expert.act()

    def take_over(self, until_told: bool = True) -> None:
        self.expert.take_over(until_told)

    def hand_back(self) -> None:
        self.expert.hand_back()

    def label(self) -> np.ndarray:
        return self.expert.label()

    def call(self, is_called: bool) -> None:
        self.expert.call(is_called)

    def verdict(self) -> Verdict | None:
        return self.expert.verdict()

    def close(self) -> None:
        self.expert.close()


class Staying(Beside):
    """Once the expert has taken over, it acts until the attempt ends."""

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._stays = False

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = super().wants_control(observation, policy_action)
        if wants and not self._stays:
            self._stays = True
            self.expert.take_over()
        has_left = (
            self.decides and not wants and super().verdict() is not None
        )  # ended by a person, who has no action for it
        return self._stays and not has_left


class Demonstrating(Beside):
    """In an attempt that is a demonstration the expert takes over before its first step, to stay.

    Attributes:
        demonstrates: Set it before the attempt.
    """

    def __init__(self, expert: Expert) -> None:
        super().__init__(expert)
        self.demonstrates = False

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        if self.demonstrates:
            self.expert.take_over()


class Redoing(Demonstrating):
    """In a try the policy acts, and the expert's wish to take over ends it; in a demonstration the expert acts all the time.

    Attributes:
        was_needed: Whether the expert ended the last try by taking over.
    """

    def __init__(self, expert: Expert) -> None:
        super().__init__(expert)
        self.was_needed = False

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self.was_needed &= self.demonstrates

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = super().wants_control(observation, policy_action)
        if not self.demonstrates:
            self.was_needed |= wants
        return wants or self.demonstrates

    def verdict(self) -> Verdict | None:
        verdict = super().verdict()
        if verdict is Verdict.DISCARD and not self.demonstrates:
            self.was_needed = False  # void, whoever was about to act
        is_over = self.was_needed and not self.demonstrates
        return verdict or (Verdict.DISCARD if is_over else None)


class Labelling(Beside):
    """Lets the policy act, and notes what the expert would do in its place.

    Attributes:
        labels: The expert's action (action dim,) of every step of the attempt.

    Raises:
        ExpertError: The expert cannot say what to do while somebody else acts.
    """

    def __init__(self, expert: Expert) -> None:
        if not expert.can_label:
            raise ExpertError(
                "--method.type=dagger asks the expert in every step what to do while the policy acts, and this expert "
                "cannot say that: nobody steers an arm that does not follow. Give --expert.type=scripted, or another method."
            )
        super().__init__(expert)
        self.labels: list[np.ndarray] = []

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        assert isinstance(env.action_space, gym.spaces.Box)
        self._space, self.labels = env.action_space, []

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        super().wants_control(observation, policy_action)
        label = np.asarray(self.expert.label(), np.float32)
        self.labels.append(label.clip(self._space.low, self._space.high))
        return False


class Late(Beside):
    """Takes over some steps after the expert would, if it still wants to then.

    Args:
        expert: The expert.
        n_steps: How many.
    """

    def __init__(self, expert: Expert, n_steps: int) -> None:
        super().__init__(expert)
        self._n_steps = n_steps

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._wished_for = 0

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = super().wants_control(observation, policy_action)
        self._wished_for = self._wished_for + 1 if wants else 0
        if self._wished_for == self._n_steps + 1:
            self.expert.take_over(until_told=False)  # from where the hand is now
        return self._wished_for > self._n_steps


class Early(Beside):
    """Takes over some steps before the expert would for the first time, which a rehearsal of the attempt finds out.

    After a reset with `is_rehearsal` nobody takes over, and the attempt is void as soon as the expert would; a real one follows
    on the same seed. Later mistakes of the attempt are corrected when the expert says so.

    Args:
        expert: The expert.
        n_steps: How many.

    Attributes:
        is_rehearsal: Set it before the attempt.

    Raises:
        InputError: The expert is a person, who cannot be asked twice.
    """

    def __init__(self, expert: Expert, n_steps: int, env: gym.Env) -> None:
        if expert.decides or not expert.can_label:
            raise InputError(
                "--takeover_delay_s below 0 plays every attempt twice, to know when the expert would take over: only a "
                "script does the same again. Give 0 or more."
            )
        super().__init__(expert)
        self._n_steps, self.is_rehearsal = n_steps, False
        self._first: float = np.inf

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._step = -1
        if self.is_rehearsal:
            self._first = np.inf

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants, self._step = super().wants_control(observation, policy_action), self._step + 1
        if self.is_rehearsal:
            self._first = min(self._first, self._step) if wants else self._first
            return False
        begins = max(self._first - self._n_steps, 0)
        if self._step == begins:
            self.expert.take_over(until_told=False)
        return wants or begins <= self._step < self._first

    def verdict(self) -> Verdict | None:
        if self.is_rehearsal and self._first < np.inf:
            return Verdict.DISCARD
        return super().verdict()


def shifted(expert: Expert, delay_s: float, fps: float, env: gym.Env) -> Expert:
    """An expert that takes over so many seconds later, or, where they are below 0, earlier.

    Raises:
        InputError: A person is the expert, or the time is shorter than a step.
    """
    n_steps = round(delay_s * fps)
    if delay_s == 0:
        return expert
    if n_steps == 0:
        raise InputError(
            f"--takeover_delay_s={delay_s}: that is less than half a step at {fps:g} steps per second. Give at least "
            f"{1 / fps:g}, or leave it out."
        )
    if n_steps > 0 and expert.decides and not expert.can_label:
        raise InputError(
            f"--takeover_delay_s={delay_s}: a person who takes over has the control at once. Leave it out; a script's person "
            "(--expert.person=true) has --expert.reaction_s."
        )
    return Late(expert, n_steps) if n_steps > 0 else Early(expert, -n_steps, env)
