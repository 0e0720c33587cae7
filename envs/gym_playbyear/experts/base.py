"""What all gates of a scripted expert share: who acts in this step, and until which of its stages a correction lasts."""

from collections.abc import Mapping
from typing import Any

import numpy as np


class StagedGate:
    """The scripted expert beside a policy: says at every step who acts, and acts.

    A gate of a task says what it looks at (`_look`), when to take over (`_find_reason`), and where the expert begins then
    (`_take_over`, which also sets `_hands_back_at`). Whoever decides in its place calls `take_over` and `hand_back`, and asks
    for a `label` where the policy acts.

    Args:
        env: The unwrapped environment, after `reset`.
        expert: Made for this episode; its phase is set anew whenever it takes over.

    Attributes:
        reason: Why the expert is in control, in one word; None while the policy is.
    """

    stages: Mapping[str, int]
    """Of each of the expert's phases, in the order in which a task goes through them."""

    def __init__(self, env: Any, expert: Any):
        self.env, self.expert = env, expert
        self.reason: str | None = None
        self._n_steps = 0
        self._touched_at: int | None = None
        self._hands_back_at = max(self.stages.values()) + 1
        self._last_action: np.ndarray | None = None
        self._is_told = False  # somebody else says until when the expert acts
        self._labelled: str | None = None  # the mistake that the last label was for

    def wants_control(self, policy_action: np.ndarray) -> bool:
        """Whether the expert acts in this step. Call it once per step, before the step.

        Args:
            policy_action: (4,) what the policy would do.
        """
        action = np.asarray(policy_action, dtype=float)
        self._look()
        is_done = self.stages[self.expert.phase] >= self._hands_back_at and not self._is_told
        if self.reason is not None and is_done:
            self.reason = None  # the stage that went wrong is done: the policy may go on
        if self.reason is None:
            self.reason = self._find_reason(action)
            if self.reason is not None and self.reason != self._labelled:
                self._take_over()
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
        self._take_over()
        self._is_told = until_told

    def hand_back(self) -> None:
        """The policy acts again; the next mistake is a new one."""
        self.reason, self._is_told = None, False

    def label(self) -> np.ndarray:
        """What the expert would do now, (4,), although the policy acts. Call it after `wants_control`, in every step.

        Every step is judged anew, because the expert does not lead the hand: it is set to where the hand is.
        """
        if self.reason is None or self.reason == self._labelled:
            self._follow()
        action = self.act()
        self.reason, self._labelled = None, self.reason
        return action

    def _follow(self) -> None:
        """Sets the expert to what the policy is doing by itself; a task's gate that can tell says how."""

    def _look(self) -> None:
        raise NotImplementedError

    def _find_reason(self, action: np.ndarray) -> str | None:
        raise NotImplementedError

    def _take_over(self) -> None:
        raise NotImplementedError
