"""Rules by which an attempt ends: solved, shoved, pressed on, groped. A task lists those that it wants.

A rule keeps what it has to remember of the episode, and is copied with its environment. `env` is the environment, `TaskEnv`.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np


class Rule:
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


class Solved(Rule):
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


class Shoved(Rule):
    """A thing was moved along the table before it was ever lifted or held.

    Args:
        prop: What must not be shoved.
        distance: How far it may move [m].
        carried_height: Its own height above which it counts as lifted [m, world].
        squeeze: Force of the hand from which on it counts as held [N].
    """

    name = "shoved"

    def __init__(self, prop: str, distance: float, carried_height: float = np.inf, squeeze: float = np.inf):
        self.prop, self.distance, self.carried_height, self.squeeze = prop, distance, carried_height, squeeze

    def begin(self, env: Any) -> None:
        self._first, self._was_carried = env.position(self.prop), False

    def applies(self, env: Any) -> bool:
        place = env.position(self.prop)
        is_held = env.contact_forces[f"gripper-{self.prop}"] > self.squeeze
        self._was_carried |= bool(place[2] > self.carried_height or is_held)
        return not self._was_carried and bool(np.linalg.norm((place - self._first)[:2]) > self.distance)


class Pressed(Rule):
    """A protective stop: the hand came down on a thing that is not between its fingers, as arms for people stop at a push.

    The side of a finger gives a push along the table, and at most `friction` times that along the finger: a squeeze, however
    hard, and what is lifted or set down by it. What is beyond that comes from the underside of a finger, or of the hand. It
    is judged at every physics step.

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
        """Largest force of a part of the hand along its approach in the last step, beyond what its side may give [N]."""
        forces = env.hand_forces(self.prop)  # (T, parts, 3)
        across = np.hypot(forces[..., 0], forces[..., 1])
        return float((np.abs(forces[..., 2]) - self.friction * across).max())


class Groped(Rule):
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
