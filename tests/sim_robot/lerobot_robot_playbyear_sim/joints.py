"""An arm of joints that go where they are told, with cameras that move, and a leader that a test moves."""

import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.robots.utils import ensure_safe_goal_position
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, TeleopEvents

JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")


@RobotConfig.register_subclass("playbyear_joints")
@dataclass(kw_only=True)
class JointArmConfig(RobotConfig):
    """Args:
    pictures: (height, width) of each camera.
    speed: Of the joints [units per second].
    joints: Their names.
    start: Where they are at first; 0 if not named.
    use_degrees: Which units it says it has.
    """

    pictures: dict[str, tuple[int, int]] = field(default_factory=lambda: {"front": (48, 64)})
    speed: float = 1000.0
    joints: list[str] = field(default_factory=lambda: [name.removesuffix(".pos") for name in JOINTS])
    start: dict[str, float] = field(default_factory=dict)
    use_degrees: bool = True
    max_relative_target: float | None = None


class JointArm(Robot):
    config_class = JointArmConfig
    name = "playbyear_joints"
    is_calibrated = True

    def __init__(self, config: JointArmConfig) -> None:
        super().__init__(config)
        self.config = config
        self.is_on = False
        self.is_blind = False
        self.told: list[tuple[float, np.ndarray]] = []
        self.joints = [f"{name}.pos" for name in config.joints]
        self.place = self.target = np.array([config.start.get(name, 0.0) for name in self.joints])
        self.sag = np.zeros(len(self.joints))
        self._at = time.perf_counter()
        rng = np.random.default_rng(0)
        self._backgrounds = {
            n: rng.integers(0, 256, (h, w, 3)).astype(np.uint8) for n, (h, w) in config.pictures.items()
        }
        self.n_observed = 0

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(self.joints, float), **{n: (h, w, 3) for n, (h, w) in self.config.pictures.items()}}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.joints, float)

    @property
    def is_connected(self) -> bool:
        return self.is_on

    def connect(self, calibrate: bool = True) -> None:
        self.is_on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def _move(self) -> None:
        now = time.perf_counter()
        most = self.config.speed * (now - self._at)
        self.place = self.place + np.clip(self.target - self.place, -most, most)
        self._at = now

    def push(self, by: np.ndarray) -> None:
        """Somebody moves it by hand."""
        self.place = self.target = self.place + by

    def get_observation(self) -> dict[str, Any]:
        if self.is_blind:
            raise TimeoutError("front latest frame is too old")
        self._move()
        self.n_observed += 1
        pictures = {n: np.roll(b, 7 * self.n_observed, axis=1) for n, b in self._backgrounds.items()}
        return {**dict(zip(self.joints, (self.place + self.sag).tolist(), strict=True)), **pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._move()
        if self.config.max_relative_target is not None:
            now = dict(zip(self.joints, self.place, strict=True))
            goals = {name: (action[name], now[name]) for name in self.joints}
            action = ensure_safe_goal_position(goals, self.config.max_relative_target)
        self.target = np.array([action[name] for name in self.joints], float)
        assert np.isfinite(self.target).all()
        self.told.append((time.perf_counter(), self.target.copy()))
        return action

    def disconnect(self) -> None:
        self.is_on = False


@TeleoperatorConfig.register_subclass("playbyear_joint_leader")
@dataclass(kw_only=True)
class JointLeaderConfig(TeleoperatorConfig):
    """Args:
    has_motors: Whether it can be moved to the follower.
    """

    has_motors: bool = False


class JointLeader(Teleoperator):
    config_class = JointLeaderConfig
    name = "playbyear_joint_leader"
    is_calibrated = True

    def __init__(self, config: JointLeaderConfig) -> None:
        super().__init__(config)
        self.is_on, self.is_held, self.button = False, False, False
        self.place = dict.fromkeys(JOINTS, 0.0)
        self.fed: list[dict[str, float]] = []
        if config.has_motors:
            self.enable_torque, self.disable_torque = self._enable_torque, self._disable_torque

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(reversed(JOINTS), float)  # another order than the robot's

    @property
    def feedback_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float) if hasattr(self, "enable_torque") else {}

    @property
    def is_connected(self) -> bool:
        return self.is_on

    def connect(self, calibrate: bool = True) -> None:
        self.is_on = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        return dict(self.place)

    def get_teleop_events(self) -> dict[TeleopEvents, bool]:
        return {TeleopEvents.IS_INTERVENTION: self.button}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        assert self.is_held
        self.place = dict(feedback)
        self.fed.append(dict(feedback))

    def _enable_torque(self) -> None:
        self.is_held = True

    def _disable_torque(self) -> None:
        self.is_held = False

    def disconnect(self) -> None:
        self.is_on = False
