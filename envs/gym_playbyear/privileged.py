"""What experts, tests and probes may know of an episode, and a policy may not."""

from typing import Any

import mujoco
import numpy as np
from gymnasium.error import ResetNeeded

from gym_playbyear.proprioception import Proprioception
from gym_playbyear.scene import Contacts
from gym_playbyear.task import Controller, Task

_FAR_BELOW = -10.0  # m


class PrivilegedState:
    """The true state behind the observations, for an environment to inherit.

    What the task's `place` returned is here by its names (`env.hidden_range`), and so is where each prop is
    (`env.cube_position` for a prop named `cube`).

    Attributes:
        shown: What the camera shows of the episode, in numbers by name.
        secrets: What nothing but sound tells of it, by name; `info` says it when the episode is over.
        materials: What props are made of in this episode, where that is not their usual material.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    definition: Task
    contacts: Contacts
    shown: dict[str, Any]
    secrets: dict[str, Any]
    materials: dict[str, str]
    _controller: Controller
    _success: Any
    _tool: int
    _fingers: slice
    _peak_forces: np.ndarray
    _expert_rng: np.random.Generator | None
    np_random: np.random.Generator
    _rollout_sensors: np.ndarray

    def __getattr__(self, name: str) -> Any:
        for known in (self.__dict__.get("shown", {}), self.__dict__.get("secrets", {})):
            if name in known:
                return known[name]
        definition = self.__dict__.get("definition")
        prop = name.removesuffix("_position")
        if definition is not None and prop != name and prop in {prop.name for prop in definition.props}:
            return self.position(prop)
        if definition is not None and name == "intervention_gate":
            raise AttributeError(f"{self.__dict__['task']} has no intervention gate.")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def camera_numbers(self) -> dict[str, Any]:
        """What the camera shows of the episode and of the moment, in numbers: scripts that do not hear may know it."""
        return {**self.shown, **(self.definition.sees(self) if self.definition.sees else {})}

    def deaf_scripts(self) -> dict[str, Any]:
        """The task's own scripts that feel with the arm and do not hear (`gym_playbyear.adversaries`), by name."""
        return dict(self.definition.deaf)

    @property
    def check_limits(self) -> dict[str, float]:
        """What the task promises of those who play it, where that differs from other tasks."""
        return dict(self.definition.limits)

    @property
    def success_rule(self) -> Any:
        """The rule by which this environment's episodes succeed, with what it remembers of the present one."""
        return self._success

    @property
    def control_hz(self) -> int:
        """Control steps per second."""
        return self.definition.control_hz

    @property
    def is_as_wanted(self) -> bool:
        """Whether all is as the task wants it, though perhaps not for long enough yet."""
        return self.definition.success.condition(self)

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
        return self.data.site_xpos[self._tool].copy()

    @property
    def gripper_obeys(self) -> bool:
        """Whether a change of the gripper's command takes effect in the next step; for 2 s after the last one it does not."""
        return self._controller.gripper_obeys

    @property
    def finger_positions(self) -> np.ndarray:
        """(2,) [m], without sensor noise."""
        return self.data.qpos[self._fingers].copy()

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Which contacts are measured."""
        return self.contacts.pairs

    @property
    def contact_forces(self) -> dict[str, float]:
        """Largest net force of each pair of bodies in the last control step [N], e.g. `gripper-table`."""
        return {f"{a}-{b}": float(force) for (a, b), force in zip(self.pairs, self._peak_forces, strict=True)}

    def hand_forces(self, name: str) -> np.ndarray:
        """Forces between the parts of the hand (`arm.touching`) and a loose prop in the last control step's T physics steps
        (T, parts, 3) [N, world axes]. ValueError for any other."""
        return self.contacts.hand_forces(self._rollout_sensors[0], name)

    def position(self, name: str) -> np.ndarray:
        """(3,) where a prop's body is [m, world frame]."""
        return self.data.body(name).xpos.copy()

    def put(self, name: str, position, yaw: float | None = None) -> None:
        """Sets a prop down, for a task's `place`.

        Args:
            name: Of the prop.
            position: (3,) of its body [m, world frame].
            yaw: Turn about the vertical [rad]; None: as it is in its own description.
        """
        turn = None if yaw is None else (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        body = self.model.body(name)
        if next(prop for prop in self.definition.props if prop.name == name).loose:
            self._weigh(name, True)
            address = self.model.joint(name).qposadr[0]
            self.data.qpos[address : address + 3] = position
            if turn is not None:
                self.data.qpos[address + 3 : address + 7] = turn
        else:
            body.pos[:] = position
            if turn is not None:
                body.quat[:] = turn

    def take_away(self, name: str) -> None:
        """Leaves a loose prop out of the episode, for a task's `place`: it floats far below until `put` fetches it."""
        self.put(name, (0.0, 0.0, _FAR_BELOW - self.model.body(name).id))
        self._weigh(name, False)

    def _remember_places(self) -> None:
        """Keeps what `put` and `take_away` change in the model, so that no episode depends on the one before."""
        self._usual_places = [array.copy() for array in self._places()]

    def _put_back(self) -> None:
        for array, usual in zip(self._places(), self._usual_places, strict=True):
            array[:] = usual

    def _places(self) -> tuple[np.ndarray, ...]:
        return self.model.body_pos, self.model.body_quat, self.model.body_gravcomp

    def _weigh(self, name: str, falls: bool) -> None:
        root = self.model.body(name).id
        self.model.body_gravcomp[self.model.body_rootid == root] = 0.0 if falls else 1.0

    def _fresh_sensors(self) -> Proprioception:
        """The arm's sensors in a new episode. What wanders in them draws nothing from `np_random`."""
        seeds: Any = self.np_random.bit_generator.seed_seq
        rng = np.random.default_rng(seeds.spawn(1)[0])
        return Proprioception(self.definition.sensors, self.control_hz, rng)
