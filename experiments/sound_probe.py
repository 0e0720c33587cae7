"""An environment whose sound is swapped at one moment: another episode's contact where there is none, or the reverse."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from gym_playbyear.arena import CUBE_HALF_SIZE, TABLE_TOP
from gym_playbyear.arm import FINGER_THICKNESS
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.script import Script

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
        seed: Of the episode.
        swapped_at: Step after which the policy heard the swapped sound; None if the moment never came.
        reacted_after: Steps until the sweep stopped; None if it went on.
        n_awaited: Steps that were there to react: fewer than `REACTION_STEPS` if the episode ended.
        closed_there: Whether it later closed the fingers where the false contact told it to.
    """

    seed: int = -1
    swapped_at: int | None = None
    reacted_after: int | None = None
    n_awaited: int = 0
    closed_there: bool = False


@dataclass
class _History:
    actions: list[np.ndarray] = field(default_factory=list)
    y: list[float] = field(default_factory=list)


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
        if mode not in ("false", "muted", "control"):
            raise ValueError(f"mode={mode!r}: choose false, muted or control.")
        self._mode, self._donors = mode, donors
        self._task: Any = env.unwrapped
        self._reach = self._task.variant.arm.max_opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE
        self.trial = Trial()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is None:
            return self.env.reset(options=options)
        self._rng = np.random.default_rng([seed, 1])
        self._donor = self._donors[self._rng.integers(len(self._donors))]
        self._wait = int(self._rng.integers(0, 6))
        self.trial, self._past = Trial(seed=seed), _History()
        if self._mode != "muted":
            lower, upper = self._task.variant.cube_y
            y = lower + (upper - lower) / 4 * float(self._rng.integers(1, 5)) - _FAR_END
            options = {**(options or {}), "cube_position": (0.0, y)}
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._past.actions.append(np.array(action, dtype=float))
        self._past.y.append(float(self._task.eef_position[1]))
        trial = self.trial
        if trial.swapped_at is None and self._is_moment():
            trial.swapped_at = len(self._past.actions)
        if trial.swapped_at is not None:
            observation = self._swap(observation, len(self._past.actions) - trial.swapped_at)
            self._judge()
            truncated = truncated or self._is_over()
        return observation, reward, terminated, truncated, info

    def _is_moment(self) -> bool:
        touched = self._task.contact_forces["gripper-cube"] > 0
        if self._mode == "muted":
            return touched and self._is_sweeping()
        way = float(self._task.cube_position[1]) - self._past.y[-1] - self._reach
        if touched or way < _FREE_WAY or not self._is_sweeping():
            return False
        self._wait -= 1
        return self._wait < 0

    def _is_sweeping(self) -> bool:
        before = self._past.actions[-_N_BEFORE:]
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

    def _judge(self) -> None:
        trial, actions = self.trial, self._past.actions
        start = trial.swapped_at
        assert start is not None
        after = [float(action[1]) for action in actions[start:]]
        trial.n_awaited = min(len(after), REACTION_STEPS)
        limit = _STOPPED_SHARE * float(np.mean([action[1] for action in actions[start - _N_BEFORE : start]]))
        if trial.reacted_after is None:
            slow = [y < limit for y in after[: REACTION_STEPS + _N_STOPPED - 1]]
            stops = [k for k in range(len(slow) - _N_STOPPED + 1) if all(slow[k : k + _N_STOPPED])]
            trial.reacted_after = stops[0] + 1 if stops else None
        if len(after) <= _GRASP_WINDOW and after and actions[-1][3] > 0 and not trial.closed_there:
            there = self._past.y[start - 1] + self._reach
            trial.closed_there = abs(self._past.y[-1] - there) < CUBE_HALF_SIZE

    def _is_over(self) -> bool:
        assert self.trial.swapped_at is not None
        n_after = len(self._past.actions) - self.trial.swapped_at
        return n_after >= (_GRASP_WINDOW if self._mode == "false" else REACTION_STEPS + _N_STOPPED)


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
