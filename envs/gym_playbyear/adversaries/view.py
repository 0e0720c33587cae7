"""What a deaf policy gets of an episode, and nothing else.

An environment knows where the hidden object is. A script that held the environment could look; therefore a script gets numbers
only: what the arm measures of itself, with its noise, and what the camera shows. No object behind the scenes can be reached
from them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_playbyear.proprioception import Proprioception
from gym_playbyear.task import Task
from gym_playbyear.task_env import TaskEnv

_NOISE_STREAM = 7  # tells the sensors' random numbers from those of a script with the same seed
_WANDER_STREAM = 8
_FINGER_JOINTS = slice(7, 9)
_UNTOUCHED = 1e-9  # N


@dataclass(frozen=True)
class TaskFacts:
    """What anyone may know of a task before an episode begins.

    Attributes:
        horizon: Steps of an episode.
        base: The robot's base (3,) [m, world]; `agent_pos` counts from it.
        line_x: Where the hidden object's range lies across [m, world].
        max_opening: Distance between the open fingers [m].
        cooldown: Steps for which a change of the gripper's command blocks the next one.
        max_shove: How far the hidden object may be moved along the table before the attempt has failed [m].
        max_lead: How far the commanded point may run ahead of the measured one [m].
        workspace: Lower and upper corner of where the commanded point may be (2, 3) [m, world].
        control_hz: Steps per second.
    """

    horizon: int
    base: np.ndarray
    line_x: float
    max_opening: float
    cooldown: int
    max_shove: float
    max_lead: float
    workspace: np.ndarray
    control_hz: float


@dataclass(frozen=True)
class DeafView:
    """One observation.

    Attributes:
        agent_pos: (7,) float32 as the policy gets it: hand x, y, z [m, from the robot's base], two finger positions [m], two
            finger velocities [m/s].
        shown: What the camera shows, in numbers, as the task says: `hidden_range` (2,) [m, world], `bin_position` (3,) where
            there is a tray, how the bag's walls are bent [rad].
        step: Steps since the episode began.
    """

    agent_pos: np.ndarray
    shown: dict[str, np.ndarray]
    step: int


def camera_numbers(env: Any) -> dict[str, np.ndarray]:
    """What the camera shows of the episode, in numbers.

    Args:
        env: The unwrapped environment, after its reset.
    """
    return {name: np.array(value, dtype=float) for name, value in env.camera_numbers().items()}


class DeafTask:
    """A task as a deaf player meets it: nothing is rendered, nothing is heard.

    Args:
        task: Its name, such as `OccludedGrasp-v1`, or the task.
        options: Of `TaskEnv`.

    Attributes:
        env: The unwrapped environment, for whoever judges. Never hand it to a script.
    """

    def __init__(self, task: str | Task, **options: Any):
        self.env = TaskEnv(task, **{"sound": "none", **options})
        definition, variant, hz = self.env.definition, self.env.variant, float(self.env.control_hz)
        arm = definition.arm
        self.facts = TaskFacts(
            horizon=int(self.env._max_episode_steps),
            base=np.array(arm.base, dtype=float),
            line_x=float(np.mean(getattr(variant, "cube_x", 0.0))),
            max_opening=float(arm.max_opening),
            cooldown=round(getattr(arm, "gripper_cooldown", 0.0) * hz),
            max_shove=float(getattr(variant, "max_shove", np.inf)),
            max_lead=float(getattr(arm, "max_lead", np.inf)),
            workspace=np.array(getattr(arm, "workspace", ((-np.inf,) * 3, (np.inf,) * 3)), dtype=float),
            control_hz=hz,
        )
        hidden = {f"gripper-{prop.name}" for prop in definition.props if prop.hidden}
        self._touches = [pair for pair in self.env.contact_forces if pair in hidden]
        self._sensors = Proprioception(definition.sensors, hz)
        self._rng = np.random.default_rng(0)
        self._n_steps = 0
        self.has_touched = False

    def begin(self, seed: int, **options: Any) -> DeafView:
        """Begins an episode. The sensors' noise follows from the seed.

        Args:
            seed: Of the episode.
            options: Of the environment's reset.
        """
        self.env.begin_episode(seed=seed, options=options)
        self._rng = np.random.default_rng([seed, _NOISE_STREAM])
        self._sensors = Proprioception(
            self.env.definition.sensors, self.facts.control_hz, np.random.default_rng([seed, _WANDER_STREAM])
        )
        self._n_steps = 0
        self.has_touched = False
        return self._view()

    def advance(self, action: np.ndarray) -> tuple[DeafView, bool, dict[str, Any]]:
        """One step. Returns the view, whether the episode is over, and the environment's `info` with how it ended in `end`."""
        _, terminated, truncated, info = self.env.advance(action)
        self._n_steps += 1
        self.has_touched |= self.touch_force > _UNTOUCHED
        if terminated or truncated:
            ended = "success" if info["is_success"] else "time" if truncated else "failed"
            info = {"end": ended, **{key: value for key, value in info.items() if value is not None}}
        return self._view(), terminated or truncated, info

    @property
    def touch_force(self) -> float:
        """Largest force between the hand and a hidden object in the last step [N]; for judges."""
        forces = self.env.contact_forces
        return max((forces[pair] for pair in self._touches), default=0.0)

    @property
    def can_be_touched(self) -> bool:
        """Whether the hand can touch what is hidden; what is shut in it cannot."""
        return bool(self._touches)

    def close(self) -> None:
        self.env.close()

    def _view(self) -> DeafView:
        env = self.env
        hand = env.eef_position - self.facts.base
        true = np.concatenate([hand, env.finger_positions, env.data.qvel[_FINGER_JOINTS]])
        return DeafView(self._sensors.measure(true, self._rng), camera_numbers(env), self._n_steps)
