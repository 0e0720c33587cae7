"""What the deaf scripts share: dead reckoning of where the hand was sent, motions, grasp, lift and placing.

A script is written as a generator of actions that looks at `self.view`; see `gym_playbyear.adversaries.tapping`.
"""

from collections.abc import Generator

import numpy as np

from gym_playbyear.adversaries.view import DeafView, TaskFacts
from gym_playbyear.arena import CUBE_HALF_SIZE, TABLE_TOP
from gym_playbyear.arm import ACTION_SCALE, FINGER_THICKNESS

Actions = Generator[np.ndarray, None, None]
Verdict = Generator[np.ndarray, None, bool]

FAST = 0.03  # m per step: the arm follows
GRASP_HEIGHT = 0.022  # m, of the hand above the table: the fingers' tips are 9 mm lower
TRAVEL_HEIGHT = 0.062  # m: the tips pass over the cube
CARRY_HEIGHT = 0.11  # m
RELEASE_HEIGHT = 0.075  # m
TIP_BELOW_HAND = 0.0086  # m: how far the fingers' tips are below the point that is controlled
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
        self.reach = (
            facts.max_opening / 2 + FINGER_THICKNESS + CUBE_HALF_SIZE
        )  # from hand to cube, when an open finger touches
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
        return np.array([self.facts.line_x, y, TABLE_TOP + height])
