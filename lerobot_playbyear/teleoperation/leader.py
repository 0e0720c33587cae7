"""A device whose cable was pulled: let go of by force, and a leader that is connected anew."""

import contextlib
import logging
from typing import Any

from lerobot.robots import Robot
from lerobot.teleoperators import Teleoperator

from lerobot_playbyear.episodes.terminal import alone


def let_go(device: Robot | Teleoperator) -> None:
    """Disconnects a device, also one that does not answer any more; what that says is logged."""
    try:
        if device.is_connected:
            device.disconnect()
    except Exception as error:  # whatever a maker's software may say
        logging.warning(f"{device.name} could not be disconnected: {error}")
        close_parts(device)


def close_parts(device: Robot | Teleoperator) -> None:
    """Closes cameras and motors one by one, as LeRobot does not where one of them fails.

    A port that is gone cannot be told to take the torque off. LeRobot then leaves it open, and refuses to connect again.
    """
    own = list(vars(device).values())
    parts = [*own, *(part for value in own if isinstance(value, dict) for part in value.values())]
    for part in parts:
        if isinstance(part, Robot | Teleoperator):  # one arm of two
            close_parts(part)
            continue
        for options in ({}, {"disable_torque": False}) if callable(getattr(part, "disconnect", None)) else ():
            with contextlib.suppress(Exception):  # most were never opened
                part.disconnect(**options)
                break


def problem_of(leader: Any) -> str:
    """Why a leader cannot be used; empty if it can."""
    if not leader.is_connected:
        return "The leader is no longer connected."
    try:
        leader.get_action()
    except Exception as error:
        return f"The leader does not answer: {error}"
    return ""


def connected_anew(leader: Any) -> str:
    """Lets go of a leader and connects to it. Returns why it cannot be used; empty if it can."""
    let_go(leader)
    try:
        with alone():  # it may ask for its calibration
            leader.connect()
    except Exception as error:
        close_parts(leader)
        return f"The leader cannot be connected: {error}"
    return problem_of(leader)
