"""What a LeRobot robot is made of: names of its numbers, cameras, and how to close what it left open."""

import contextlib
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from lerobot.robots import Robot, RobotConfig

from lerobot_playbyear.datasets.errors import PlaybyearError


class RobotError(PlaybyearError, RuntimeError):
    """A robot, or something on it, cannot be used; the message says what, and what to do. Nothing saved is lost."""


def names_of(
    robot_type: str, observations: Mapping[str, Any], actions: Mapping[str, Any]
) -> tuple[list[str], dict[str, tuple[int, ...]], list[str]]:
    """Sorts a robot's features.

    Args:
        robot_type: For messages.
        observations, actions: Its `observation_features` and `action_features`.

    Returns:
        Names of the numbers that it observes, the shape (height, width, 3) of each camera, and names of its actions.

    Raises:
        RobotError: It gives, or takes, something that has no place in an environment.
    """
    states = [name for name, kind in observations.items() if kind in (float, int)]
    cameras = {name: tuple(kind) for name, kind in observations.items() if isinstance(kind, tuple | list)}
    strange = [
        f"{name}: {kind}"
        for name, kind in observations.items()
        if name not in states and not (name in cameras and cameras[name][2:] == (3,))
    ]
    if strange:
        raise RobotError(
            f"--env.robot.type={robot_type} observes {', '.join(strange)}; wanted numbers and pictures (height, width, "
            "3). Turn it off in the robot's options."
        )
    told = [name for name, kind in actions.items() if kind in (float, int)]
    if not told or len(told) < len(actions):
        raise RobotError(f"--env.robot.type={robot_type} takes {dict(actions)}; wanted numbers by name.")
    return states, cameras, told


def fill_in_limit(config: RobotConfig, limit: float) -> bool:
    """Gives a robot's options, and those of each arm of one that has two, a `max_relative_target` where they have none.

    Args:
        config: Of the robot; it is changed.
        limit: How far from where it is a joint may be told to go, in its units.

    Returns:
        Whether the robot has such an option at all.
    """
    parts = [part for part in (config, *vars(config).values()) if is_dataclass(part)]
    limited: list[Any] = [part for part in parts if hasattr(part, "max_relative_target")]
    for part in limited:
        if part.max_relative_target is None:
            part.max_relative_target = limit
    return bool(limited)


def reconnect_cameras(robot: Robot) -> None:
    """Opens those cameras anew that do not answer; the joints keep what they are doing."""
    cameras: Mapping[str, Any] = getattr(robot, "cameras", {})
    for camera in cameras.values():
        try:
            camera.read_latest()
        except Exception:  # whatever a camera's own program may raise
            with contextlib.suppress(Exception):
                camera.disconnect()
            with contextlib.suppress(Exception):
                camera.connect()
