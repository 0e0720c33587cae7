"""Actions of the end effector for a robot of joints: displacements of the hand become joint targets."""

import logging
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from draccus.utils import DecodingError

from lerobot_playbyear.robots.arm import Arm, RobotError
from lerobot_playbyear.teleoperation.actions import DELTAS, GRIPPER

_OPTION = "--env.end_effector"
_POSITION = ".pos"
_MOST_ITERATIONS = 10
_CLOSE_ENOUGH_M, _REACHED_M = 1e-4, 5e-4
_SHARES = (1.0, 0.5, 0.25, 0.125)
_MOST_TURN = 30.0  # of a joint in one step [degrees]: more is a leap to another posture


@dataclass
class EndEffectorConfig:
    """The environment's actions are displacements of the hand in the robot's base frame, and the gripper.

    Args:
        urdf_path: The robot's description. Its joints have the names of the robot's own, and its zeros.
        target_frame_name: What is moved: a frame (link) of the description.
        step_m: A displacement of 1 along an axis, per step [m].
        bounds_min: The workspace's smallest x, y and z in the base frame [m]. None: no limit.
        bounds_max: The workspace's largest x, y and z [m]. None: no limit.
        gripper: The joint that is the gripper. None: the robot has none.
        gripper_open: Where it is open, in the robot's units.
        gripper_closed: Where it is closed.
        gripper_step: How far a gripper action of 1 moves it per step, in the robot's units.
        orientation_weight: How much keeping the hand's orientation counts beside its place; an arm of five joints or fewer
            keeps it only as far as the place allows.
    """

    urdf_path: str = ""
    target_frame_name: str = "gripper_frame_link"
    step_m: float = 0.02
    bounds_min: list[float] | None = None
    bounds_max: list[float] | None = None
    gripper: str | None = "gripper"
    gripper_open: float = 100.0
    gripper_closed: float = 0.0
    gripper_step: float = 10.0
    orientation_weight: float = 0.01

    def __post_init__(self) -> None:
        for name in ("step_m", "gripper_step"):
            if not 0 < getattr(self, name) < 1e6:
                raise self._error(name, "give a number above 0")
        if not 0 <= self.orientation_weight < 1e6:
            raise self._error("orientation_weight", "give 0 or more")
        for name in ("bounds_min", "bounds_max"):
            corner = getattr(self, name)
            if corner is not None and (len(corner) != 3 or not np.isfinite(corner).all()):
                raise self._error(name, "give three finite numbers, such as [0.1, -0.2, 0.02]")
        low, high = self.bounds()
        if not (low < high).all():
            raise self._error("bounds_min", f"each number must be below that of bounds_max, {self.bounds_max}")
        if not np.isfinite([self.gripper_open, self.gripper_closed]).all() or self.gripper_open == self.gripper_closed:
            raise self._error("gripper_closed", f"give another place than gripper_open, {self.gripper_open}")

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The workspace's smallest and largest x, y and z, (3,) each [m]; infinite where there is no limit."""
        low = np.full(3, -np.inf) if self.bounds_min is None else np.array(self.bounds_min, np.float64)
        high = np.full(3, np.inf) if self.bounds_max is None else np.array(self.bounds_max, np.float64)
        return low, high

    def _error(self, name: str, what_to_do: str) -> DecodingError:
        return DecodingError(("env", "end_effector", name), f"{getattr(self, name)!r} does not work: {what_to_do}.")


class EndEffector:
    """Moves an arm by its hand, with LeRobot's processors and kinematics.

    The hand's target moves by what the actions say, and not from where the hand is measured: an arm that sags does not creep.
    Where a displacement cannot be reached, or would turn a joint by more than it may, a part of it is made, or none: the hand
    keeps its line, and its target never runs away from the arm.

    Args:
        arm: Of joints in degrees; it need not be connected.
        config: The options.

    Attributes:
        action_names: `delta_x`, `delta_y`, `delta_z`, and `gripper` if there is one. Each is in [-1, 1]; a gripper above 0
            closes, below 0 opens, 0 stays.

    Raises:
        RobotError: The robot, its description or the kinematics cannot be used; nothing has moved.
    """

    def __init__(self, arm: Arm, config: EndEffectorConfig) -> None:
        self._arm, self._config = arm, config
        self._joints, self._has_gripper = _joints(arm, config), config.gripper is not None
        self.action_names = [*DELTAS, *([GRIPPER] if self._has_gripper else [])]
        _check_description(config, self._joints)
        self._kinematics = _kinematics(config, self._joints)
        self._make_processors()
        self._target: np.ndarray | None = None  # (3,) [m]; None: where the hand is
        self._breaks = -1

    def send(self, action: np.ndarray, state: np.ndarray) -> None:
        """Moves the hand.

        Args:
            action: (len(action_names),); what is beyond [-1, 1] is cut off.
            state: The arm's (len(arm.state_names),), for the beginning.

        Raises:
            ValueError: The action is not finite; nothing was sent.
            RobotError: The robot does not answer.
        """
        action = np.asarray(action, np.float64)
        if not np.isfinite(action).all():
            raise ValueError("The action holds a value that is not finite.")
        action = action.clip(-1, 1)
        told = dict(zip(self._arm.state_names, map(float, state), strict=True))
        if self._arm.sent is not None:
            told |= self._arm.by_name(self._arm.sent)
        if self._breaks != self._arm.n_breaks:
            self._target, self._breaks = None, self._arm.n_breaks
        targets = self._joint_targets(action, told)
        self._arm.send(np.array([targets[name] for name in self._arm.action_names]))

    def position(self, joints: Mapping[str, float]) -> np.ndarray:
        """Where the hand is in the base frame (3,) [m], for joints by name."""
        return self._kinematics.forward_kinematics(self._angles(joints))[:3, 3].copy()

    def _joint_targets(self, action: np.ndarray, told: Mapping[str, float]) -> dict[str, float]:
        """Where each joint shall be, if it was last told to be at `told`."""
        config, observation = self._config, {f"{name}{_POSITION}": told[f"{name}{_POSITION}"] for name in self._joints}
        targets = dict(observation)
        here = self.position(told)
        if self._target is None or np.linalg.norm(here - self._target) > config.step_m:  # or the arm was held back
            self._latch(here)
        assert self._target is not None
        observation[f"{config.gripper}{_POSITION}"] = told.get(
            f"{config.gripper}{_POSITION}", 0.0
        )  # LeRobot wants it last
        gripper = float(action[3]) if self._has_gripper else 0.0
        for share in _SHARES if action[:3].any() else ():
            pose = self._pose(share * action[:3], gripper, observation)
            wanted = np.array([pose[f"ee.{axis}"] for axis in "xyz"])
            solved = self._solve(pose, observation)
            if solved is not None:
                targets, self._target = solved, wanted
                break
        if self._has_gripper:
            pose = self._pose(np.zeros(3), gripper, observation)
            targets[f"{config.gripper}{_POSITION}"] = pose["ee.gripper_pos"]
        return targets

    def _latch(self, here: np.ndarray) -> None:
        """The target is where the hand is, and as it is turned."""
        self._place.reset()
        self._start = self._target = here

    def _pose(self, displacement: np.ndarray, gripper: float, observation: dict[str, float]) -> dict[str, Any]:
        """LeRobot's `ee.` values of the target that such an action makes."""
        assert self._target is not None
        config = self._config
        low, high = config.bounds()
        # From outside of the workspace it can only go inwards, and does not jump.
        self._bounds.end_effector_bounds = {
            "min": np.minimum(low, self._target),
            "max": np.maximum(high, self._target),
        }
        away = self._target + config.step_m * displacement - self._start
        closes = np.sign(config.gripper_closed - config.gripper_open)
        wish = {
            "enabled": True,
            **dict(zip(("target_x", "target_y", "target_z"), away, strict=True)),
            **dict.fromkeys(("target_wx", "target_wy", "target_wz"), 0.0),
            "gripper_vel": float(closes) * gripper,
        }
        return self._place((wish, observation))

    def _solve(self, pose: dict[str, Any], observation: dict[str, float]) -> dict[str, float] | None:
        """The joints that bring the hand there, from those of `observation`; None: it cannot be reached.

        One step of the solver keeps the orientation as well as it can, at the cost of some millimetres; the others have only
        the place to mind.
        """
        wanted = np.array([pose[f"ee.{axis}"] for axis in "xyz"])
        joints, distance = dict(observation), np.inf
        for solver in [self._turn, *[self._reach] * _MOST_ITERATIONS]:
            try:
                joints = {**joints, **solver((dict(pose), dict(joints)))}
            except RuntimeError as error:  # the solver's: there is no solution
                logging.debug(f"Inverse kinematics: {error}")
                return None
            if not np.isfinite(list(joints.values())).all():
                return None
            distance = float(np.linalg.norm(self.position(joints) - wanted))
            if distance < _CLOSE_ENOUGH_M and solver is self._reach:
                break
        turn = np.abs(self._angles(joints) - self._angles(observation)).max()
        if distance > _REACHED_M or turn > min(self._arm.max_step or _MOST_TURN, _MOST_TURN):
            return None
        return {f"{name}{_POSITION}": joints[f"{name}{_POSITION}"] for name in self._joints}

    def _angles(self, joints: Mapping[str, float]) -> np.ndarray:
        return np.array([joints[f"{name}{_POSITION}"] for name in self._joints], np.float64)  # (joints,) [degrees]

    def _make_processors(self) -> None:
        from lerobot.processor import RobotProcessorPipeline
        from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action
        from lerobot.robots.so_follower.robot_kinematic_processor import (
            EEBoundsAndSafety,
            EEReferenceAndDelta,
            GripperVelocityToJoint,
            InverseKinematicsEEToJoints,
        )

        config, kinematics, joints = self._config, self._kinematics, self._joints
        self._bounds = EEBoundsAndSafety({}, max_ee_step_m=4 * config.step_m, raise_on_jump=False)
        ends = sorted((config.gripper_open, config.gripper_closed))
        metres = dict.fromkeys("xyz", 1.0)

        def pipeline(*steps: Any) -> Any:
            return RobotProcessorPipeline(
                steps=list(steps),
                to_transition=robot_action_observation_to_transition,
                to_output=transition_to_robot_action,
            )

        self._place = pipeline(
            EEReferenceAndDelta(kinematics, metres, joints),
            self._bounds,
            GripperVelocityToJoint(speed_factor=config.gripper_step, clip_min=ends[0], clip_max=ends[1]),
        )
        self._turn, self._reach = (
            pipeline(InverseKinematicsEEToJoints(kinematics, joints, orientation_weight=weight))
            for weight in (config.orientation_weight, 0.0)
        )


def _joints(arm: Arm, config: EndEffectorConfig) -> list[str]:
    """The names of the joints that move the hand."""
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


def _check_description(config: EndEffectorConfig, joints: list[str]) -> None:
    """That the URDF is there, and has the joints and the frame."""
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


def _kinematics(config: EndEffectorConfig, joints: list[str]) -> Any:
    from lerobot.model import RobotKinematics

    try:
        return RobotKinematics(str(Path(config.urdf_path).expanduser()), config.target_frame_name, joints)
    except ImportError as error:
        raise RobotError(
            f'{_OPTION} needs placo, which does not load: {error} Install it: pip install "lerobot[kinematics]".'
        ) from error
    except Exception as error:  # whatever placo may say of a description
        raise RobotError(f"{_OPTION}.urdf_path={config.urdf_path} cannot be used: {error}") from error
