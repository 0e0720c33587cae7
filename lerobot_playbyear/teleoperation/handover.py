"""A leader arm and the arm that follows it meet, before a person takes over."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
from lerobot.teleoperators import Teleoperator

from lerobot_playbyear.episodes.expert import ExpertError

_LEADER_S, _FOLLOWER_S = 2.0, 1.0  # as in LeRobot's own hand-over


def hand_over(
    env: gym.Env, teleop: Teleoperator, target: Mapping[str, float], stop: Callable[[], bool] = lambda: False
) -> None:
    """Brings leader and follower to the same pose, while the environment's time stands still.

    A leader with motors goes to where the follower is; otherwise the follower goes to where the leader is. LeRobot's own
    functions move them.

    Args:
        env: A robot's environment.
        teleop: The leader.
        target: Where the leader is, by the robot's joints.
        stop: Asked while the follower moves: then it holds.

    Raises:
        RobotError: The robot does not answer.
        ExpertError: The leader does not.
    """
    from lerobot_playbyear.compat import teleop_smooth_move_to, teleop_supports_feedback  # seconds to import

    robot_env: Any = env.unwrapped
    robot_env.hold()
    if teleop_supports_feedback(teleop):
        leader: Any = teleop
        place = robot_env.arm.position()
        try:
            teleop_smooth_move_to(leader, place, _LEADER_S)
            leader.disable_torque()  # the person moves it from here
        except Exception as error:  # its cable
            raise ExpertError(f"The leader does not answer: {error}") from error
    else:
        robot_env.arm.move_to(target, _FOLLOWER_S, stop)
    if not stop():
        robot_env.go_on()
