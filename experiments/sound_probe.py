"""An environment whose sound is swapped at one moment: another episode's contact where there is none, or the reverse."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from gym_playbyear.panda import FINGER_THICKNESS
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE, TABLE_TOP
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.pool import Script

AUDIO_KEY = "audio.gripper"
REACTION_STEPS = 10
_CONTACT_BLOCKS = 4  # steps of another episode's contact sound, 0.2 s
_QUIET_BLOCKS = 12  # steps of another episode's sweep that stand in for a muted contact
_SWEEP_HEIGHT = 0.045  # m above the table: the hand is lower only while it sweeps or grasps
_SWEEPING = 0.06  # mean of the action's y over the last steps from which it is a sweep: 3 mm a step
_N_BEFORE = 5  # steps that tell how fast the sweep was
_N_STOPPED = 3  # steps in a row that count as a stop
_STOPPED_SHARE = 1 / 3  # of the speed before
_FREE_WAY = 0.08  # m to the cube, so that no true contact comes while the reaction is awaited
_FAR_END = 0.01  # m from the end of its quarter: where the cube waits while a false contact is played
_GRASP_WINDOW = 60  # steps after the false contact in which closing the fingers counts


@dataclass(frozen=True)
class Donor:
    """Sound of an expert's episode: blocks (n, S) int16 from the touch on, and from the sweep before it."""

    contact: np.ndarray
    quiet: np.ndarray


@dataclass
class Trial:
    """What happened after the swap.

    Attributes:
        swapped_at: Step after which the policy heard the swapped sound; None if the moment never came.
        reacted_after: Steps until the sweep stopped; None if it went on.
        closed_there: Whether it later closed the fingers where the false contact told it to.
    """

    swapped_at: int | None = None
    reacted_after: int | None = None
    closed_there: bool = False


class SoundProbe(gym.Wrapper):
    """Swaps the gripper's sound once per episode.

    Args:
        env: Occluded Grasp, with sound.
        mode: "false" plays a contact in mid-sweep, "muted" plays a quiet sweep from the first touch on, "control" swaps
            nothing at the moment at which "false" would.
        donors: Where the sounds come from.
    """

    def __init__(self, env: gym.Env, mode: str, donors: list[Donor]):
        super().__init__(env)
        self._mode, self._donors = mode, donors
        self._task: Any = env.unwrapped
        self._reach = self._task.definition.arm.max_opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is None:
            return self.env.reset(options=options)
        self._rng = np.random.default_rng([seed, 1])
        self._donor = self._donors[self._rng.integers(len(self._donors))]
        self._wait = int(self._rng.integers(0, 6))
        self._swapped_at: int | None = None
        self._actions: list[np.ndarray] = []
        self._y: list[float] = []  # of the hand, after each of them
        if self._mode != "muted":
            lower, upper = self._task.definition.numbers.cube_y
            y = lower + (upper - lower) / 4 * float(self._rng.integers(1, 5)) - _FAR_END
            options = {**(options or {}), "cube_position": (0.0, y)}
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._actions.append(np.array(action, dtype=float))
        self._y.append(float(self._task.eef_position[1]))
        if self._swapped_at is None and self._is_moment():
            self._swapped_at = len(self._actions)
        if self._swapped_at is not None:
            n_after = len(self._actions) - self._swapped_at
            observation = self._swap(observation, n_after)
            truncated = truncated or n_after >= (
                _GRASP_WINDOW if self._mode == "false" else REACTION_STEPS + _N_STOPPED
            )
        return observation, reward, terminated, truncated, info

    @property
    def trial(self) -> Trial:
        """Of the last episode."""
        start = self._swapped_at
        if start is None:
            return Trial()
        after = self._actions[start:]
        limit = _STOPPED_SHARE * float(np.mean([action[1] for action in self._actions[start - _N_BEFORE : start]]))
        slow = [action[1] < limit for action in after[: REACTION_STEPS + _N_STOPPED - 1]]
        stops = (k + 1 for k in range(len(slow) - _N_STOPPED + 1) if all(slow[k : k + _N_STOPPED]))
        there = self._y[start - 1] + self._reach
        grasps = zip(after[:_GRASP_WINDOW], self._y[start:], strict=False)
        closed_there = any(action[3] > 0 and abs(y - there) < CUBE_HALF_SIZE for action, y in grasps)
        return Trial(start, next(stops, None), closed_there)

    def _is_moment(self) -> bool:
        touched = self._task.contact_forces["gripper-cube"] > 0
        if self._mode == "muted":
            return touched and self._is_sweeping()
        way = float(self._task.position("cube")[1]) - self._y[-1] - self._reach
        if touched or way < _FREE_WAY or not self._is_sweeping():
            return False
        self._wait -= 1
        return self._wait < 0

    def _is_sweeping(self) -> bool:
        before = self._actions[-_N_BEFORE:]
        low = self._task.eef_position[2] < TABLE_TOP + _SWEEP_HEIGHT
        return low and len(before) == _N_BEFORE and float(np.mean([a[1] for a in before])) > _SWEEPING

    def _swap(self, observation: dict[str, Any], n: int) -> dict[str, Any]:
        if self._mode == "muted":
            block = self._donor.quiet[n % len(self._donor.quiet)]
        elif self._mode == "false" and n < len(self._donor.contact):
            block = self._donor.contact[n]
        else:
            return observation
        return {**observation, AUDIO_KEY: block.copy()}


def make_donors(env: gym.Env, seeds: range) -> list[Donor]:
    """Sounds of the expert's own episodes in an environment."""
    donors = []
    task: Any = env.unwrapped
    for seed in seeds:
        episode = play(env, Script(), seed, watch=lambda: task.contact_forces["gripper-cube"] > 0)
        blocks = [observation[AUDIO_KEY] for observation in episode.observations]
        touched_at = next((step for step, touched in enumerate(episode.watched) if touched), None)
        if touched_at is not None and touched_at > _QUIET_BLOCKS and len(blocks) >= touched_at + _CONTACT_BLOCKS:
            contact = np.stack(blocks[touched_at : touched_at + _CONTACT_BLOCKS])
            donors.append(Donor(contact, np.stack(blocks[touched_at - _QUIET_BLOCKS : touched_at])))
    return donors
