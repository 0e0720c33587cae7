"""How an attempt ends: solved, shoved, pressed on, groped; and whether it acted before anything was heard.

What is here keeps what it has to remember of the episode, and is copied with its environment, `env`, a `TaskEnv`.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np


class Termination:
    """Something that may end an attempt.

    Attributes:
        name: What `info["end"]` says when it did.
    """

    name: ClassVar[str]

    def begin(self, env: Any) -> None:
        """An episode begins; the scene has settled."""

    def applies(self, env: Any) -> bool:
        """Whether the attempt ends now. Asked once after every control step."""
        raise NotImplementedError


class Success(Termination):
    """The task is solved, at once or when it has stayed so.

    Args:
        condition: `condition(env)`: whether all is as it should be.
        prop: What has to stay where it is meanwhile; None: nothing.
        seconds: For how long; 0: the first step at which it is so, or of a `prop` the second.
        tolerance: How far it may move in that time [m].
    """

    name = "success"

    def __init__(
        self, condition: Callable[[Any], bool], prop: str | None = None, seconds: float = 0.0, tolerance: float = np.inf
    ):
        self.condition, self.prop, self.seconds, self.tolerance = condition, prop, seconds, tolerance

    def begin(self, env: Any) -> None:
        self._since: np.ndarray | None = None
        self._n_steps = 0

    def applies(self, env: Any) -> bool:
        if not self.condition(env):
            self._since, self._n_steps = None, 0
            return False
        if self.prop is not None:
            place = env.position(self.prop)
            if self._since is None or np.linalg.norm(place - self._since) > self.tolerance:
                self._since, self._n_steps = place, 0
                return False
        self._n_steps += 1
        return self._n_steps >= self.seconds * env.control_hz


class Shoved(Termination):
    """A thing was moved along the table before it was ever lifted or held.

    Args:
        prop: What must not be shoved.
        distance: How far it may move [m].
        carried_height: Its own height above which it counts as lifted [m, world].
        squeeze: With which both fingers, the first two parts of the hand, press on it from either side along y from which on it
            counts as held [N]. One finger that jams it against a rail holds nothing.
    """

    name = "shoved"

    def __init__(self, prop: str, distance: float, carried_height: float = np.inf, squeeze: float = np.inf):
        self.prop, self.distance, self.carried_height, self.squeeze = prop, distance, carried_height, squeeze

    def begin(self, env: Any) -> None:
        self._first, self._was_carried = env.position(self.prop), False

    def applies(self, env: Any) -> bool:
        place = env.position(self.prop)
        left, right = env.hand_forces(self.prop)[:, :2, 1].T  # (T,) each
        squeeze = (np.abs(left - right) - np.abs(left + right)) / 2  # the smaller of both where they are opposed
        self._was_carried |= bool(place[2] > self.carried_height or squeeze.max() > self.squeeze)
        return not self._was_carried and bool(np.linalg.norm((place - self._first)[:2]) > self.distance)


class Pressed(Termination):
    """A protective stop: the hand pressed on a thing that is not between its fingers, as arms for people stop at a push.

    The side of a finger that faces the other pushes along y, and gives at most `friction` times that along other axes: a
    squeeze, however hard, and what is lifted or set down by it. What is beyond that comes from the underside of a finger or
    of the hand, or from a finger's edge, as when it jams the thing against a rail. It is judged at every physics step.

    Args:
        prop: What must not be pressed on, a loose thing.
        limit: Largest force of one part of the hand [N]. A stiff arm gives 80 N and more when it comes down on a thing.
        friction: Between the hand and the thing.
    """

    name = "pressed"

    def __init__(self, prop: str, limit: float, friction: float):
        self.prop, self.limit, self.friction = prop, limit, friction

    def applies(self, env: Any) -> bool:
        return self.force(env) > self.limit

    def force(self, env: Any) -> float:
        """Largest force of a part of the hand in the last step, beyond what a finger's side may give [N]."""
        x, y, z = np.moveaxis(env.hand_forces(self.prop), -1, 0)  # (T, parts) each
        return float((np.hypot(x, z) - self.friction * np.abs(y)).max())


class Groped(Termination):
    """The hand closed on nothing too often: what keeps someone who cannot hear from trying one place after the other.

    Args:
        closings: The how-manieth ends the attempt.
        empty: Fingers that are nearer to each other hold nothing [m].
    """

    name = "groped"

    def __init__(self, closings: int = 3, empty: float = 0.004):
        self.closings, self.empty = closings, empty

    def begin(self, env: Any) -> None:
        self.n_closings, self._was_empty = 0, False

    def applies(self, env: Any) -> bool:
        opening = float(env.finger_positions.sum())
        if opening < self.empty and not self._was_empty:
            self.n_closings += 1
            self._was_empty = True
        elif opening > 3 * self.empty:
            self._was_empty = False
        return self.n_closings >= self.closings


_TOUCHES = 0.2  # N: from here on a contact counts as heard
_OPEN = 0.9  # share of the opening: below it the hand closes
_MOVED = 0.02  # m: more than the scripts' noise and what is left of a motion


class EarlyAction:
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


class ClosedUnheard(EarlyAction):
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


class MovedUnheard(EarlyAction):
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
