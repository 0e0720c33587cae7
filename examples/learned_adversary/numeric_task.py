"""A task in numbers, for learners: a deaf player's observation, a dense privileged reward, and nothing is rendered.

What a learner sees has two parts. The first is the player's: what a deaf policy gets, and, if it hears, how hard the hand
touches. The second is the truth behind the scenes, for a critic alone, which helps to train the player and is not there
when it plays.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numeric_terms import N_SHOWN, N_TRUTH, terms_of

from gym_playbyear.check.deaf import DeafTask, DeafView
from gym_playbyear.panda import ACTION_SCALE

N_HEARD = 4
N_PLAYER = 17 + N_SHOWN + N_HEARD
_SPEED = 0.5  # m/s per unit of action: what a hand covers that searches and grasps
_SUCCESS = 5.0  # a failure costs nothing: else who seldom succeeds learns not to try
DISCOUNT = 0.995  # half of it is left after 140 actions, most of an episode: patience must be worth while
_HEARD = 0.2  # N: what the scripted expert takes for a touch


class NumericTask(gym.Env):
    """A task whose observations are numbers.

    `observation_space`: the player's `N_PLAYER` numbers, of which the last `N_HEARD` are what it hears, then the truth's
    `N_TRUTH`. `action_space`: (4,) in [-1, 1]: displacement along x, y, z in units of `step_size` [m] for each of `repeat`
    steps; the gripper closes above 0.5, opens below -0.5, and stays as it is between.

    Args:
        task: Its name, such as `OccludedGrasp-v1`.
        hears: Whether the player gets the contact signal. A deaf player gets zeros.
        repeat: Steps of the task for each action; by default as many as fit into a tenth of a second, one at least.
        discount: Of the learner; the reward's shaping is a potential's difference, which changes no best policy.
        options: For `gymnasium.make`.
    """

    def __init__(
        self, task: str, *, hears: bool, repeat: int | None = None, discount: float = DISCOUNT, **options: Any
    ):
        self.task = DeafTask(task, **options)
        self.hears, self.discount = hears, discount
        self.repeat = repeat or max(1, round(self.task.facts.control_hz / 10))
        self.step_size = min(ACTION_SCALE, _SPEED / self.task.facts.control_hz)
        self.task.begin(0)
        self.terms = terms_of(self.task)
        self.observation_space = spaces.Box(-np.inf, np.inf, (N_PLAYER + N_TRUTH,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._view: DeafView
        self._sent: np.ndarray
        self._touch: np.ndarray
        self._side: float
        self._closes = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        episode = int(self.np_random.integers(2**31)) if seed is None else seed
        self._view = self.task.begin(episode, **(options or {}))
        self.terms.begin()
        self._last_action: np.ndarray = np.zeros(4)
        self._closes, self._changed_at = False, -(10**6)
        self._sent = self._hand()
        self.begin_action()
        self._potential = self.terms.worth(self._view.shown, self._closes)
        return self._observe(), {}

    def step(self, action):
        control = self.control(action)
        done = False
        info: dict[str, Any] = {}
        self.begin_action()
        for _ in range(self.repeat):
            done, info = self.advance(control)
            if done:
                break
        reward = self.reward(done, info)
        return self.end_action(action), reward, done, False, info

    # The same in parts, for a teacher that acts in every step of the task

    @property
    def view(self) -> DeafView:
        """What a deaf script gets."""
        return self._view

    def begin_action(self) -> None:
        """A new action's touches are counted from here."""
        self._touch, self._side = np.zeros(2), 0.0

    def end_action(self, action: np.ndarray) -> np.ndarray:
        """The observation after an action (4,) that was taken step by step."""
        self._last_action = np.append(action[:3], 1.0 if self._closes else -1.0)
        return self._observe()

    def control(self, action: np.ndarray) -> np.ndarray:
        """The task's action (4,) for the learner's."""
        closes = bool(action[3] > (-0.5 if self._closes else 0.5))
        return np.append(np.clip(action[:3], -1, 1) * self.step_size / ACTION_SCALE, 1.0 if closes else -1.0)

    def advance(self, control: np.ndarray) -> tuple[bool, dict[str, Any]]:
        """One step of the task itself. Whether the episode is over, and the task's `info`."""
        if (control[3] > 0) != self._closes and self._view.step - self._changed_at > self.task.facts.cooldown:
            self._closes, self._changed_at = bool(control[3] > 0), self._view.step
        facts = self.task.facts
        lead = self._sent + control[:3] * ACTION_SCALE - self._hand()
        distance = max(float(np.linalg.norm(lead)), 1e-9)
        self._sent = np.clip(self._hand() + lead * min(1.0, facts.max_lead / distance), *facts.workspace)
        self._view, done, info = self.task.advance(control)
        lag = self._hand() - self._sent
        if np.abs(lag).max() < 0.001:
            self._sent = self._sent + 0.1 * lag
        heard = self.terms.heard()
        self._touch = np.maximum(self._touch, heard)
        if heard[0] > _HEARD:
            self._side = self.terms.side()
        return done, info

    def reward(self, done: bool, info: dict[str, Any]) -> float:
        """What the last action earned."""
        before, self._potential = self._potential, self.terms.worth(self._view.shown, self._closes)
        if done:
            self._potential = 0.0
        earned = self.discount * self._potential - before
        return float(earned + (_SUCCESS if done and info["is_success"] else 0.0))

    def close(self):
        self.task.close()

    # What there is to see

    def _observe(self) -> np.ndarray:
        facts, view, hand = self.task.facts, self._view, self._hand()
        cooling = np.clip(1 - (view.step - self._changed_at) / max(facts.cooldown, 1), 0, 1)
        shown = self.terms.shown(view.shown, hand)
        player = np.concatenate(
            [
                (hand - self.terms.middle(view.shown)) / 0.05,
                view.agent_pos[3:5] / facts.max_opening * 4 - 1,
                view.agent_pos[5:7] / 0.05,
                np.clip((hand - self._sent) / 0.001, -5, 5),
                self._last_action,
                [1.0 if self._closes else -1.0, cooling, 2 * view.step / facts.horizon - 1],
                shown,
                np.zeros(N_SHOWN - len(shown)),
                np.log1p(self._touch / _HEARD) / 3 if self.hears else np.zeros(2),
                [self._side if self.hears else 0.0, float(self.hears)],
            ]
        )
        return np.concatenate([player, self.terms.truth(self._closes), [self._potential]]).astype(np.float32)

    def _hand(self) -> np.ndarray:
        """(3,) where the hand says that it is [m, world]."""
        return self._view.agent_pos[:3] + self.task.facts.base
