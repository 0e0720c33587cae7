"""What a deaf policy gets of an episode and nothing else, and what the scripts that play with it share.

An environment knows where the hidden object is. A script that held the environment could look; therefore a script gets numbers
only: what the arm measures of itself, with its noise, and what the camera shows. No object behind the scenes can be reached
from them. A script is written as a generator of actions that looks at `self.view`; `check.occluded` has examples.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

import numpy as np

from gym_playbyear.environment import TaskEnv
from gym_playbyear.panda import ACTION_SCALE, FINGER_THICKNESS, Proprioception
from gym_playbyear.task import Task
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE, LINE_X, TABLE_TOP
from gym_playbyear.terminations import Shoved

_NOISE_STREAM = 7  # tells the sensors' random numbers from those of a script with the same seed
_WANDER_STREAM = 8
_UNTOUCHED = 1e-9  # N


@dataclass(frozen=True)
class TaskFacts:
    """What anyone may know of a task before an episode begins.

    Attributes:
        horizon: Steps of an episode.
        base: The robot's base (3,) [m, world]; `agent_pos` counts from it.
        max_opening: Distance between the open fingers [m].
        cooldown: Steps for which a change of the gripper's command blocks the next one.
        max_shove: How far the hidden object may be moved along the table before the attempt has failed [m].
        max_lead: How far the commanded point may run ahead of the measured one [m].
        workspace: Lower and upper corner of where the commanded point may be (2, 3) [m, world].
        control_hz: Steps per second.
    """

    horizon: int
    base: np.ndarray
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
        definition, hz = self.env.definition, float(self.env.control_hz)
        arm = definition.arm
        shoves = [rule.distance for rule in definition.terminations if isinstance(rule, Shoved)]
        self.facts = TaskFacts(
            horizon=int(self.env._max_episode_steps),
            base=np.array(arm.base, dtype=float),
            max_opening=float(arm.max_opening),
            cooldown=round(arm.gripper_cooldown * hz),
            max_shove=min(shoves, default=np.inf),
            max_lead=float(arm.max_lead),
            workspace=np.array(arm.workspace, dtype=float),
            control_hz=hz,
        )
        hidden = {f"gripper-{prop.name}" for prop in definition.props if prop.hidden}
        self._touches = [pair for pair in self.env.contact_forces if pair in hidden]
        self._sensors = Proprioception(definition.sensors, hz)
        self._rng = np.random.default_rng(0)
        self.has_touched = False

    def begin(self, seed: int, **options: Any) -> DeafView:
        """Begins an episode. The sensors' noise follows from the seed.

        Args:
            seed: Of the episode.
            options: Of the environment's reset.
        """
        self.env.reset_physics(seed=seed, options=options)
        self._rng = np.random.default_rng([seed, _NOISE_STREAM])
        self._sensors = Proprioception(
            self.env.definition.sensors, self.facts.control_hz, np.random.default_rng([seed, _WANDER_STREAM])
        )
        self.has_touched = False
        return self._view()

    def advance(self, action: np.ndarray) -> tuple[DeafView, bool, dict[str, Any]]:
        """One step. Returns the view, whether the episode is over, and the environment's `info` with how it ended in `end`."""
        _, terminated, truncated, info = self.env.step_physics(action)
        self.has_touched |= self.touch_force > _UNTOUCHED
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
        shown = {name: np.array(value, dtype=float) for name, value in self.env.camera_numbers().items()}
        return DeafView(self._sensors.measure(self.env.true_proprioception(), self._rng), shown, self.env.n_steps)


Actions = Generator[np.ndarray, None, None]

FAST = 0.03  # m per step: the arm follows
GRASP_HEIGHT = 0.022  # m, of the hand above the table: the fingers' tips are 9 mm lower
TRAVEL_HEIGHT = 0.062  # m: the tips pass over the cube
CARRY_HEIGHT = 0.11  # m
RELEASE_HEIGHT = 0.075  # m
_AT_REST = 0.0015  # m per step
_HOLDS = CUBE_HALF_SIZE * 2 - 0.010  # m: fingers this far apart that are told to close hold something


class DeafScript:
    """Acts on what a deaf policy gets, and on nothing else. Subclasses write `_plan`.

    Args:
        facts: What anyone may know of the task.
        rng: What the script draws from.
    """

    def __init__(self, facts: TaskFacts, rng: np.random.Generator):
        self.facts, self.rng = facts, rng
        # From hand to cube, when an open finger touches.
        self.reach = facts.max_opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE
        self._closes = False
        self._last_change = -(10**6)  # step of the gripper's last change of command
        self._sent: np.ndarray = np.zeros(3)  # where the hand was sent [m, world], as the arm's controller reckons it
        self._hand_before = np.zeros(3)  # where it was a step ago
        self._actions = self._plan()
        self.view: DeafView | None = None

    def act(self, view: DeafView) -> np.ndarray:
        """The action (4,) for what was just observed."""
        if self.view is None:
            self._sent = view.agent_pos[:3] + self.facts.base
        self._hand_before = self._sent if self.view is None else self.hand
        self.view = view
        return next(self._actions, self._move(np.zeros(3)))

    def _plan(self) -> Actions:
        raise NotImplementedError

    # What the script senses

    @property
    def _seen(self) -> DeafView:
        assert self.view is not None, "act was not called yet"
        return self.view

    @property
    def hand(self) -> np.ndarray:
        """(3,) where the hand says that it is [m, world]."""
        return self._seen.agent_pos[:3] + self.facts.base

    @property
    def opening(self) -> float:
        """Between the fingers, as measured [m]."""
        return float(self._seen.agent_pos[3:5].sum())

    @property
    def lag(self) -> np.ndarray:
        """(3,) how far the hand is ahead of where it was sent [m]: an obstacle shows here."""
        return self.hand - self._sent

    @property
    def hidden_range(self) -> tuple[float, float]:
        lower, upper = self._seen.shown["hidden_range"]
        return float(lower), float(upper)

    @property
    def steps_left(self) -> int:
        return self.facts.horizon - self._seen.step

    @property
    def may_change_grip(self) -> bool:
        """Whether the gripper obeys a new command."""
        return self._seen.step - self._last_change > self.facts.cooldown

    def height(self) -> float:
        """Of the hand above the table, as measured [m]."""
        return float(self.hand[2] - TABLE_TOP)

    def _recalibrate(self, axes: slice = slice(0, 3)) -> None:
        """Believes the measured place of a hand that rests in the air half, and half the reckoned one."""
        if np.abs(self.hand - self._hand_before).max() < _AT_REST:
            self._sent[axes] += 0.5 * self.lag[axes]

    # Motions: generators of actions

    def _move(self, displacement: np.ndarray) -> np.ndarray:
        """The action (4,) that sends the hand this far [m], at most `ACTION_SCALE` along each axis."""
        step = np.clip(displacement, -ACTION_SCALE, ACTION_SCALE)
        lead = self._sent + step - self.hand
        distance = max(float(np.linalg.norm(lead)), 1e-9)
        self._sent = np.clip(self.hand + lead * min(1.0, self.facts.max_lead / distance), *self.facts.workspace)
        return np.append(step / ACTION_SCALE, 1.0 if self._closes else -1.0).astype(np.float32)

    def _wait(self, n_steps: int) -> Actions:
        for _ in range(n_steps):
            yield self._move(np.zeros(3))

    def _go(self, goal: np.ndarray, max_step: float = FAST, *, settle: int = 1) -> Actions:
        """To a point (3,) [m, world] in a straight line, `settle` steps longer than it is commanded."""
        while True:
            way = goal - self._sent
            distance = float(np.linalg.norm(way))
            if distance < 1e-4:
                break
            yield self._move(way * min(1.0, max_step / distance))
        yield from self._wait(settle)

    def _rise(self, height: float, max_step: float = FAST) -> Actions:
        """Straight up to so high above the table [m]; what pressed on something is taken back first."""
        yield from self._go(np.array([*self._sent[:2], TABLE_TOP + height]), max_step)

    def _set_grip(self, closes: bool) -> Actions:
        """Opens or closes once the gripper obeys, and waits until the fingers rest."""
        if closes == self._closes:
            return
        while not self.may_change_grip:
            yield self._move(np.zeros(3))
        self._closes, self._last_change = closes, self._seen.step
        before = np.inf
        for _ in range(16):
            yield self._move(np.zeros(3))
            if abs(self.opening - before) < 0.0007 and self._seen.step - self._last_change > 2:
                break
            before = self.opening

    def _grasp(self) -> Actions:
        """Closes where the hand is, lifts what it holds, and places it if there is a tray. Ends when it holds nothing."""
        yield from self._set_grip(True)
        if not self.holds:
            return
        yield from self._rise(CARRY_HEIGHT, 0.02)
        if "bin_position" in self._seen.shown and self.holds:
            yield from self._place()
        while self.holds:  # success is for the environment to see
            yield self._move(np.zeros(3))

    def _place(self) -> Actions:
        tray = self._seen.shown["bin_position"]
        yield from self._go(np.array([tray[0], tray[1], TABLE_TOP + CARRY_HEIGHT]), 0.02, settle=3)
        yield from self._go(np.array([tray[0], tray[1], TABLE_TOP + RELEASE_HEIGHT]), 0.01, settle=2)
        if self.holds:
            yield from self._set_grip(False)
            yield from self._wait(self.facts.horizon)

    @property
    def holds(self) -> bool:
        """Whether fingers that are told to close are apart."""
        return self._closes and self.opening > _HOLDS

    def _on_line(self, y: float, height: float) -> np.ndarray:
        """A point above where the object may lie (3,) [m, world]."""
        return np.array([LINE_X, y, TABLE_TOP + height])


ScriptMaker = Callable[[TaskFacts, np.random.Generator], DeafScript]
"""Makes a deaf script for one episode."""
