"""Actions of the end effector for a robot of joints: displacements of the hand become joint targets."""

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_playbyear.robots.arm import Arm
from lerobot_playbyear.robots.end_effector_config import EndEffectorConfig
from lerobot_playbyear.robots.urdf import hand_joints, make_kinematics
from lerobot_playbyear.teleoperation.actions import DELTAS, GRIPPER

_POSITION = ".pos"
_MOST_ITERATIONS = 10
_CLOSE_ENOUGH_M, _REACHED_M = 1e-4, 5e-4
_SHARES = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32)
_MOST_TURN = 30.0  # of a joint in one step [degrees]: more is a leap to another posture
_LEAST_EASE = 0.02  # [m/rad]: the arm is not stretched further; this costs some millimetres of its reach


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
        self._joints, self._has_gripper = hand_joints(arm, config), config.gripper is not None
        self.action_names = [*DELTAS, *([GRIPPER] if self._has_gripper else [])]
        self._kinematics = make_kinematics(config, self._joints)
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
        the place to mind. Where the orientation would take a large turn of a joint, only the place counts.
        """
        place_only = [self._reach] * _MOST_ITERATIONS
        for solvers in ([self._turn, *place_only], place_only):
            joints = self._iterate(solvers, pose, observation)
            if joints is not None:
                return {f"{name}{_POSITION}": joints[f"{name}{_POSITION}"] for name in self._joints}
        return None

    def _iterate(
        self, solvers: list[Any], pose: dict[str, Any], observation: dict[str, float]
    ) -> dict[str, float] | None:
        """The joints after these steps of the solver; None: they are not where the hand shall be, or too far to turn."""
        wanted = np.array([pose[f"ee.{axis}"] for axis in "xyz"])
        joints, distance = dict(observation), np.inf
        for solver in solvers:
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
        ease = self._ease(joints)
        return None if ease < _LEAST_EASE and ease < self._ease(observation) else joints

    def _ease(self, joints: Mapping[str, float]) -> float:
        """How fast the hand moves per turn of the joints, in the direction in which that is slowest [m/rad].

        It is 0 where the arm is stretched: from there no small turn of the joints brings the hand back.
        """
        angles, turn = self._angles(joints), 0.1  # degrees
        turned = [self._kinematics.forward_kinematics(angles + turn * each)[:3, 3] for each in np.eye(len(angles))]
        jacobian = (np.array(turned) - self.position(joints)) / np.deg2rad(turn)  # (joints, 3)
        return float(np.linalg.svd(jacobian, compute_uv=False)[-1])

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
