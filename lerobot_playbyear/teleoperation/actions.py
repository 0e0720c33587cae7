"""From what a LeRobot teleoperator gives to an environment's action."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_playbyear.episodes.expert import ExpertError

DELTAS = ("delta_x", "delta_y", "delta_z")
GRIPPER = "gripper"
CLOSE, STAY, OPEN = 0, 1, 2
"""How LeRobot's teleoperators code the gripper."""

KNOWN_DIRECTIONS = {"keyboard_ee": "-x,-y,z", "gamepad": "-y,x,z"}
"""For the view of our tasks (right on the screen is x, away is y), per type of teleoperator; others have `x,y,z`."""


class ActionMapping:
    """Makes action vectors of a teleoperator's.

    A teleoperator that moves the hand (`delta_x`, `delta_y`, `delta_z`) fits an environment whose actions are three
    displacements, or these and a gripper (> 0 closes). Any other fits an environment with as many numbers as it gives.

    Args:
        features: The teleoperator's `action_features`.
        space: The environment's actions.
        directions: What moves the hand along x, y and z: three of `x`, `y`, `z`, with `-` for the opposite direction.
        speed: What a full displacement of the teleoperator is for the environment, whose largest is 1.

    Raises:
        ExpertError: They do not fit, or `directions` is none.
    """

    def __init__(self, features: Mapping[str, Any], space: gym.Space, directions: str, speed: float) -> None:
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise ExpertError(f"A person can act where actions are a Box of one dimension; here they are {space}.")
        self._names = action_names(features)
        self._low, self._high, self._speed = space.low, space.high, speed
        n = space.shape[0]
        self.moves_hand = set(DELTAS) <= set(self._names)
        self.has_gripper = self.moves_hand and n == len(DELTAS) + 1
        if n != len(self._names) and not (self.moves_hand and n in (3, 4)):
            raise ExpertError(
                f"The teleoperator gives {', '.join(self._names) or 'nothing'}, and the environment's action is {n} numbers. "
                "Give a teleoperator of the end effector (--expert.teleop.type=keyboard_window, keyboard_ee, gamepad) for "
                "actions dx, dy, dz and gripper, or one with as many numbers as the action has."
            )
        self._axes, self._signs = _parse(directions)

    def vector(self, action: Mapping[str, Any], gripper: float = 0.0) -> np.ndarray:
        """The action vector (action dim,), inside the environment's limits.

        Args:
            action: What the teleoperator's `get_action` returned.
            gripper: The command to the gripper, if there is one.
        """
        if self.moves_hand:
            deltas = np.array([float(action[name]) for name in DELTAS])
            values = list(self._speed * self._signs * deltas[self._axes])
            values += [gripper] if self.has_gripper else []
        else:
            values = [float(action[name]) for name in self._names]
        return np.asarray(values, np.float32).clip(self._low, self._high)


class Gripper:
    """What the gripper is told, whoever tells it: after a change the next one is blocked for a while.

    The environment does the same, so that recorded commands are those that were carried out.

    Args:
        cooldown_steps: For how many steps.
    """

    def __init__(self, cooldown_steps: int) -> None:
        self._cooldown_steps = cooldown_steps
        self.reset()

    def reset(self) -> None:
        """It is open and may change at once."""
        self.is_closed = False
        self._steps_since_change = self._cooldown_steps

    @property
    def blocked_steps(self) -> int:
        """Steps until it may change again."""
        return max(self._cooldown_steps - self._steps_since_change, 0)

    def wish(self, close: bool) -> bool:
        """What it can be told in the next step, if a person wants it to close, or to open."""
        return self.is_closed if self.blocked_steps else close

    def follow(self, close: bool) -> None:
        """A step was made in which the gripper was told to close, or to open."""
        self._steps_since_change += 1
        if close != self.is_closed and self._steps_since_change > self._cooldown_steps:
            self.is_closed, self._steps_since_change = close, 0


def action_names(features: Mapping[str, Any]) -> list[str]:
    """The numbers that a teleoperator gives, in their order. LeRobot has two ways to declare them."""
    names = features.get("names", features)
    return sorted(names, key=names.__getitem__) if "names" in features and isinstance(names, dict) else list(names)


def _parse(directions: str) -> tuple[np.ndarray, np.ndarray]:
    parts = [part.strip() for part in directions.split(",")]
    axes = [part.lstrip("+-") for part in parts]
    if sorted(axes) != ["x", "y", "z"] or any(len(part) > 2 for part in parts):
        raise ExpertError(
            f"--expert.directions={directions!r}: give x, y and z in some order, each with - for the opposite direction, such "
            "as -y,x,z."
        )
    return np.array(["xyz".index(axis) for axis in axes]), np.array([-1.0 if p[0] == "-" else 1.0 for p in parts])
