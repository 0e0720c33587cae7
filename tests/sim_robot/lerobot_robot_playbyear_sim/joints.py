"""An arm of joints that are where they were told to be, with a camera that moves and those that it is given, and a leader."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")
SIZE = (48, 64)


@RobotConfig.register_subclass("playbyear_joints")
@dataclass(kw_only=True)
class JointArmConfig(RobotConfig):
    """Args:
    cameras: Besides its own, `front`.
    """

    cameras: dict[str, CameraConfig] = field(default_factory=dict)


class JointArm(Robot):
    config_class = JointArmConfig
    name = "playbyear_joints"
    is_calibrated = True

    def __init__(self, config: JointArmConfig) -> None:
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self.is_on, self.n_observed = False, 0
        self.place = np.zeros(len(JOINTS))
        self._picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3)).astype(np.uint8)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        cameras = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**dict.fromkeys(JOINTS, float), "front": (*SIZE, 3), **cameras}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self.is_on

    def connect(self, calibrate: bool = True) -> None:
        for camera in self.cameras.values():
            camera.connect()
        self.is_on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        self.n_observed += 1
        pictures = {name: camera.read_latest() for name, camera in self.cameras.items()}
        front = np.roll(self._picture, 7 * self.n_observed, axis=1)
        return {**dict(zip(JOINTS, self.place.tolist(), strict=True)), "front": front, **pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.place = np.array([action[name] for name in JOINTS], float)
        assert np.isfinite(self.place).all()
        return action

    def disconnect(self) -> None:
        for camera in self.cameras.values():
            camera.disconnect()
        self.is_on = False


@TeleoperatorConfig.register_subclass("playbyear_joint_leader")
@dataclass(kw_only=True)
class JointLeaderConfig(TeleoperatorConfig):
    """A leader that stands still."""


class JointLeader(Teleoperator):
    config_class = JointLeaderConfig
    name = "playbyear_joint_leader"
    is_calibrated = True
    feedback_features: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, config: JointLeaderConfig) -> None:
        super().__init__(config)
        self.is_on = False

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self.is_on

    def connect(self, calibrate: bool = True) -> None:
        self.is_on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, 0.0)

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self.is_on = False
