"""What experts, tests and probes may know of an episode, and a policy may not."""

import mujoco
import numpy as np
from gymnasium.error import ResetNeeded

from gym_playbyear.arm import N_JOINTS, CartesianController


class PrivilegedState:
    """The true state behind the observations, for an environment to inherit."""

    data: mujoco.MjData
    pairs: tuple[tuple[str, str], ...]
    _controller: CartesianController
    _tcp: int
    _cube: int
    _peak_forces: np.ndarray
    _expert_rng: np.random.Generator | None

    @property
    def expert_rng(self) -> np.random.Generator:
        """What the episode's experts draw from.

        Raises:
            ResetNeeded: There is no episode yet.
        """
        if self._expert_rng is None:
            raise ResetNeeded("An expert was made before the first episode: call reset() first.")
        return self._expert_rng

    @property
    def eef_position(self) -> np.ndarray:
        """(3,) the point between the fingertips [m, world frame], without sensor noise."""
        return self.data.site_xpos[self._tcp].copy()

    @property
    def gripper_obeys(self) -> bool:
        """Whether a change of the gripper's command takes effect in the next step; for 2 s after the last one it does not."""
        return self._controller.gripper_obeys

    @property
    def cube_position(self) -> np.ndarray:
        """(3,) the cube's centre [m, world frame]."""
        return self.data.xpos[self._cube].copy()

    @property
    def finger_positions(self) -> np.ndarray:
        """(2,) [m], without sensor noise."""
        return self.data.qpos[N_JOINTS : N_JOINTS + 2].copy()

    @property
    def contact_forces(self) -> dict[str, float]:
        """Largest net force of each pair of bodies in the last control step [N], e.g. `gripper-cube`."""
        return {f"{a}-{b}": float(force) for (a, b), force in zip(self.pairs, self._peak_forces, strict=True)}
