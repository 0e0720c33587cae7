"""`--env.end_effector`: its options."""

from dataclasses import dataclass

import numpy as np
from draccus.utils import DecodingError


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
