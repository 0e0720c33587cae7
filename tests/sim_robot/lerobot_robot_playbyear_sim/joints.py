"""An arm of joints that are where they were told to be, with a camera that moves and those that it is given, and a leader."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig

from lerobot_robot_playbyear_sim.arm import SimulatedArm, SimulatedLeader

JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")


@RobotConfig.register_subclass("playbyear_joints")
@dataclass(kw_only=True)
class JointArmConfig(RobotConfig):
    """Args:
    cameras: In addition to its own, `front`.
    """

    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class JointArm(SimulatedArm):
    config_class = JointArmConfig
    name = "playbyear_joints"
    states = actions = JOINTS
    front_size = (48, 64)
    is_connected = False

    def connect(self, calibrate: bool = True) -> None:
        for camera in self.cameras.values():
            camera.connect()
        self.n_observed, self.place = 0, np.zeros(len(JOINTS))
        self._picture = np.random.default_rng(0).integers(0, 256, (*self.front_size, 3)).astype(np.uint8)
        self.is_connected = True

    def get_observation(self) -> dict[str, Any]:
        self.n_observed += 1
        front = np.roll(self._picture, 7 * self.n_observed, axis=1)
        return {**dict(zip(JOINTS, self.place.tolist(), strict=True)), "front": front, **self.pictures()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.place = np.array([action[name] for name in JOINTS], float)
        assert np.isfinite(self.place).all()
        return action

    def disconnect(self) -> None:
        for camera in self.cameras.values():
            camera.disconnect()
        self.is_connected = False


@TeleoperatorConfig.register_subclass("playbyear_joint_leader")
@dataclass(kw_only=True)
class JointLeaderConfig(TeleoperatorConfig):
    """A leader that stands still."""


class JointLeader(SimulatedLeader):
    config_class = JointLeaderConfig
    name = "playbyear_joint_leader"
    actions = JOINTS
    is_connected = False

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def get_action(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, 0.0)

    def disconnect(self) -> None:
        self.is_connected = False
