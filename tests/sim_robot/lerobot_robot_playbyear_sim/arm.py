"""What the arms and leaders that are not there have in common: nothing to calibrate, and numbers in an order."""

from functools import cached_property
from typing import Any

from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot
from lerobot.teleoperators import Teleoperator


class _Device:
    """Has numbers to be moved by, and nothing to calibrate."""

    actions: tuple[str, ...]

    def __init__(self, config: Any) -> None:
        super().__init__(config)  # type: ignore[call-arg]
        self.config = config

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.actions, float)

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...


class SimulatedArm(_Device, Robot):
    """An arm with a camera `front` of its own, and those that it is given."""

    is_calibrated = True
    states: tuple[str, ...]
    front_size: tuple[int, int]

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.cameras = make_cameras_from_configs(config.cameras)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        cameras = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**dict.fromkeys(self.states, float), "front": (*self.front_size, 3), **cameras}

    def pictures(self) -> dict[str, Any]:
        """Of the cameras that it was given."""
        return {name: camera.read_latest() for name, camera in self.cameras.items()}


class SimulatedLeader(_Device, Teleoperator):
    is_calibrated = True
    feedback_features: dict[str, Any] = {}  # noqa: RUF012

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
