"""What the scripts share: motions, pauses and noise; and who acts in a step, the expert or a policy, and for how long."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from gym_playbyear.panda import ACTION_SCALE


class Script:
    """What scripts share that know the task's true state: a phase, pauses, noise, steps towards a goal.

    Args:
        env: The unwrapped environment, after `reset`.

    Attributes:
        phase: What it is doing.
        rng: Where its speeds, pauses and noise come from.
    """

    GAIN = 0.5  # share of the remaining distance covered per step
    NOISE = 0.0025  # m: uniform, either way, added to every displacement
    phase: str

    def __init__(self, env: Any):
        self.env = env
        self.rng: np.random.Generator = env.expert_rng
        self._wait = 0  # steps of a pause that are left

    def _action(self, displacement: np.ndarray, closes: bool) -> np.ndarray:
        """The action (4,) that moves the hand so far [m]."""
        return np.append(np.clip(displacement / ACTION_SCALE, -1, 1), 1.0 if closes else -1.0).astype(np.float32)

    def _noise(self) -> np.ndarray:
        return self.rng.uniform(-self.NOISE, self.NOISE, 3)

    def _has_waited(self) -> bool:
        """Whether the pause is over; if not, this is one step of it."""
        if self._wait == 0:
            return True
        self._wait -= 1
        return False

    def _near(self, goal: np.ndarray, tolerance: float) -> bool:
        return bool(np.linalg.norm(goal - self.env.eef_position) < tolerance + self.NOISE)

    def _step_towards(self, goal: np.ndarray, max_step: float) -> np.ndarray:
        """(3,) a part of the way to a point, at most so long [m]."""
        displacement = self.GAIN * (goal - self.env.eef_position)
        length = float(np.linalg.norm(displacement))
        return displacement * min(1.0, max_step / length) if length > 0 else displacement


class StagedGate:
    """The scripted expert beside a policy: says at every step who acts, and acts.

    A gate of a task says what it looks at (`_look`), when to take over (`_find_reason`), and where the expert begins then
    (`_take_over`, which also sets `_hands_back_at`). Whoever decides in its place calls `take_over` and `hand_back`.

    Args:
        env: The unwrapped environment, after `reset`.
        expert: Made for this episode; its phase is set again whenever it takes over.

    Attributes:
        reason: Why the expert is in control, in one word; None while the policy is.
    """

    stages: Mapping[str, int]
    """Of each of the expert's phases, in the order in which a task goes through them."""
    still: tuple[int, float]
    """Steps in which a hand that moves less than so far [m] stands still."""

    def __init__(self, env: Any, expert: Any):
        self.env, self.expert = env, expert
        self.reason: str | None = None
        self._n_steps = 0
        self._touched_at: int | None = None
        self._hands_back_at = max(self.stages.values()) + 1
        self._last_action: np.ndarray | None = None
        self._is_told = False  # somebody else says until when the expert acts
        self._places: deque[np.ndarray] = deque(maxlen=self.still[0] + 1)

    def wants_control(self, policy_action: np.ndarray) -> bool:
        """Whether the expert acts in this step. Call it once per step, before the step.

        Args:
            policy_action: (4,) what the policy would do.
        """
        action = np.asarray(policy_action, dtype=float)
        self._look()
        self._places.append(self.env.eef_position)
        is_done = self.stages[self.expert.phase] >= self._hands_back_at and not self._is_told
        if self.reason is not None and is_done:
            self.reason = None  # the stage that went wrong is done: the policy may go on
        if self.reason is None:
            self.reason = self._find_reason(action)
            if self.reason is not None:
                self._begin()
        self._last_action = action
        self._n_steps += 1
        return self.reason is not None

    def act(self) -> np.ndarray:
        """The expert's action (4,) for the present state."""
        return self.expert.act()

    def take_over(self, until_told: bool = True) -> None:
        """The expert acts from this step on, because somebody else says so. Call it after `wants_control` and before `act`,
        or before the first step.

        Args:
            until_told: Until `hand_back`; otherwise until the stage in which it begins is done.
        """
        self.reason = self.reason or "asked"
        self._begin()
        self._is_told = until_told

    def hand_back(self) -> None:
        """The policy acts again; the next mistake is a new one."""
        self.reason, self._is_told = None, False

    def _begin(self) -> None:
        self._places.clear()
        self._take_over()

    def _is_still(self) -> bool:
        """Whether the hand stands still, for as long as it was looked at since the expert began last."""
        is_full = len(self._places) == self._places.maxlen
        return is_full and bool(np.linalg.norm(self._places[-1] - self._places[0]) < self.still[1])

    def _look(self) -> None:
        raise NotImplementedError

    def _find_reason(self, action: np.ndarray) -> str | None:
        raise NotImplementedError

    def _take_over(self) -> None:
        raise NotImplementedError
