"""Whether an attempt acted before it had heard what it needs to hear. It ends nothing, and nothing observed depends on it.

A task names one of these; `info["acted_early"]` says at the end of an attempt what it saw. `env` is the environment, `TaskEnv`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

_TOUCHES = 0.2  # N: from here on a contact counts as heard
_OPEN = 0.9  # share of the opening: below it the hand closes
_MOVED = 0.02  # m: more than the scripts' noise and what is left of a motion


class Haste:
    """What is seen of an attempt; this one, of tasks without such a question, sees nothing.

    Attributes:
        acted_early: The hand acted, the first time, before it had heard anything. None: nobody asks.
    """

    acted_early: bool | None = None

    def begin(self, env: Any) -> None:
        """An episode begins; the scene has settled."""

    def look(self, env: Any) -> None:
        """Once after every control step. What sounds in a step is heard after it, when its action was long chosen."""

    def info(self) -> dict[str, bool | int]:
        """What the environment's `info` says of the attempt when it is over."""
        return {} if self.acted_early is None else {"acted_early": self.acted_early}


class ClosedUnheard(Haste):
    """The hand began to close before it had ever touched a thing; what its closing itself touches comes too late.

    `info` also says how often the hand closed, `n_closings`: a success with one is a success of the first search.

    Args:
        prop: What has to be heard.
    """

    def __init__(self, prop: str):
        self.prop = prop

    def begin(self, env: Any) -> None:
        self.acted_early, self._is_decided = _at_the_beginning(env, self.prop)
        self._was_heard, self._is_closed, self._n_closings = False, False, 0

    def look(self, env: Any) -> None:
        was_closed = self._is_closed
        self._is_closed = bool(env.finger_positions.sum() < _OPEN * env.definition.arm.max_opening)
        self._n_closings += self._is_closed and not was_closed
        if self._is_decided:
            return
        if self._is_closed:
            self.acted_early, self._is_decided = not self._was_heard, True
        self._was_heard |= bool(env.contact_forces[f"gripper-{self.prop}"] > _TOUCHES)

    def info(self) -> dict[str, bool | int]:
        told = super().info()
        return told and {**told, "n_closings": self._n_closings}


class MovedUnheard(Haste):
    """The hand let a thing fall and moved on before it had heard it land.

    Args:
        prop: What falls.
        is_up: `is_up(env)`: whether it is high enough above the table to be dropped.
        has_landed: `has_landed(env)`: whether it lies.
    """

    def __init__(self, prop: str, is_up: Callable[[Any], bool], has_landed: Callable[[Any], bool]):
        self.prop, self.is_up, self.has_landed = prop, is_up, has_landed

    def begin(self, env: Any) -> None:
        self.acted_early, self._is_decided = _at_the_beginning(env, self.prop)
        self._let_go_at: np.ndarray | None = None  # where the hand held it up last

    def look(self, env: Any) -> None:
        if self._is_decided:
            return
        is_held = env.contact_forces[f"gripper-{self.prop}"] > _TOUCHES
        if is_held:
            self._let_go_at = env.eef_position if self.is_up(env) else None
        elif self._let_go_at is not None:
            has_moved = bool(np.linalg.norm(env.eef_position - self._let_go_at) > _MOVED)
            self.acted_early = self.acted_early or has_moved
            self._is_decided = self.has_landed(env)


def _at_the_beginning(env: Any, prop: str) -> tuple[bool | None, bool]:
    """`acted_early`, and whether that is all there is to say: a task made of another one may not have the thing any more."""
    is_there = ("gripper", prop) in env.pairs
    return (False if is_there else None), not is_there
