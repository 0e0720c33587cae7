"""What a robot's description (URDF) has to have, so that the robot can be moved by its hand."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from lerobot_playbyear.robots.arm import Arm
from lerobot_playbyear.robots.end_effector_config import EndEffectorConfig
from lerobot_playbyear.robots.parts import RobotError

_OPTION = "--env.end_effector"
_POSITION = ".pos"


def hand_joints(arm: Arm, config: EndEffectorConfig) -> list[str]:
    """The names of the joints that move the hand, in the robot's order.

    Raises:
        RobotError: The robot is not moved by joints in degrees, or has no such gripper.
    """
    kind = arm.robot.config.type
    if not arm.has_positions:
        raise RobotError(
            f"{_OPTION} turns displacements of the hand into joints, and --env.robot.type={kind} takes {arm.action_names}: "
            "leave it out, or give a robot whose actions are joints by name (.pos)."
        )
    if getattr(arm.robot.config, "use_degrees", True) is False:
        raise RobotError(f"{_OPTION} needs joints in degrees: give --env.robot.use_degrees=true, and calibrate for it.")
    names = [name.removesuffix(_POSITION) for name in arm.action_names]
    if config.gripper is not None and config.gripper not in names:
        raise RobotError(
            f"{_OPTION}.gripper={config.gripper}: the robot's joints are {', '.join(names)}. Give one of them, or null if it "
            "has no gripper."
        )
    return [name for name in names if name != config.gripper]


def make_kinematics(config: EndEffectorConfig, joints: list[str]) -> Any:
    """LeRobot's `RobotKinematics` of these joints.

    Raises:
        RobotError: The URDF is not there, or lacks a joint or the frame, or placo is not installed.
    """
    from lerobot.model import RobotKinematics

    path = _checked_description(config, joints)
    try:
        return RobotKinematics(str(path), config.target_frame_name, joints)
    except ImportError as error:
        raise RobotError(
            f'{_OPTION} needs placo, which does not load: {error} Install it: pip install "lerobot[kinematics]".'
        ) from error
    except Exception as error:  # whatever placo may say of a description
        raise RobotError(f"{_OPTION}.urdf_path={path} cannot be used: {error}") from error


def _checked_description(config: EndEffectorConfig, joints: list[str]) -> Path:
    """The URDF's path, if it has the joints and the frame."""
    path = Path(config.urdf_path).expanduser()
    if not config.urdf_path or not path.is_file():
        raise RobotError(
            f"{_OPTION}.urdf_path={config.urdf_path or 'nothing'}: there is no such file. Give the robot's URDF; that of the "
            "SO-101 is in github.com/TheRobotStudio/SO-ARM100, Simulation/SO101."
        )
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise RobotError(f"{_OPTION}.urdf_path={path} is no URDF: {error}.") from error
    there = [str(each.get("name")) for each in root.findall("joint") if each.get("type") not in (None, "fixed")]
    missing = [name for name in joints if name not in there]
    if missing:
        raise RobotError(
            f"{_OPTION}.urdf_path={path} has the joints {', '.join(there) or 'none'}, and the robot also has "
            f"{', '.join(missing)}: give the URDF of this robot, with joints named as the robot's."
        )
    links = [str(each.get("name")) for each in root.findall("link")]
    if config.target_frame_name not in links:
        raise RobotError(
            f"{_OPTION}.target_frame_name={config.target_frame_name}: {path} has the frames {', '.join(links)}. Give one."
        )
    return path
