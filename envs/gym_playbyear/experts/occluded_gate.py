"""When the scripted expert takes over from a policy, what it does then, and when it hands back.

The rules are the authors' (missed and moved on, late and hovering, dropped after lifting), and a few that come before a
mistake is final: in our tasks a cube shoved over 2.2 cm ends the attempt, and fingers closed beside the cube stay closed for
2 s. A gate looks at the state behind the scenes, and at the action that the policy is about to take.

A policy can learn from a correction if what it senses tells it what to do. Therefore the gates wait until a mistake can be
noticed: fingers closed on nothing, the hand stays on top of the cube. And the expert does not go where only it knows the cube
to be: it rises and searches again, as in a demonstration. A cube that would be put down beside the tray it carries back to
where it was lifted, and then to the tray: where a way ends is learned from the way, not from mending its end (recovery before
correction, Hu et al., "RaC", 2025).
"""

import numpy as np

from gym_playbyear.experts.base import StagedGate
from gym_playbyear.experts.occluded import GraspExpert
from gym_playbyear.panda import ACTION_SCALE
from gym_playbyear.tasks.arena import CUBE_HALF_SIZE, LINE_X, MAX_SHOVE, TABLE_TOP

# Thresholds: lengths in metres, durations in control steps, shares of the episode's steps.
MISSED_HEIGHT = 0.12  # so high above the table, after it touched the cube and without it, the hand missed and moved on
SEARCH_SHARE = 0.35  # from this share on, the same height without a touch counts as well
HOVER_SHARE = (
    0.8  # from this share on, open fingers so near the cube that change the action so little do not know what to do
)
HOVER_DISTANCE, HOVER_CHANGE = 0.05, 0.05
SHOVE_SHARE, PUSH_STEP = 0.3, 0.003  # the cube was shoved by this share of what ends the attempt, and is pushed on
GRASP_REACH, GRASP_HEIGHT = 0.012, 0.034  # the cube is between fingers whose middle is that near, and that are so low
LANDED_STEPS = 8  # the hand touched the cube from above for so long
LAND_X, LAND_HEIGHT, LAND_MARGIN = 0.035, 0.044, 0.012  # about to land: so near to the cube's middle, so far above it
EMPTY_OPENING = 0.03  # fingers that were closed, and are this near to each other, hold nothing
RELEASE_REACH = 0.02  # fingers may open when the held cube is this near to the tray's middle
CARRY_PAST, CARRY_SINK = 0.03, 0.015  # a carried cube so far past the tray, or so far too low beside it, is misplaced
FAR = 0.1  # from where it was lifted; a cube that is this far is carried back, to show the way to the tray again
DROP_DISTANCE = 0.04  # a cube that was held and is this far from the hand was dropped
STRAY_X, STRAY_Y = 0.03, 0.12  # how far a hand that searches may be beside the line of the sweep, and before its start
HOP_PAST = 0.03  # how far a hand that rose after the touch may go past the cube
MEMORY_STEPS = 40  # how long the policy hears a touch; what it does then is judged by its result
SEARCH_STEP, TRAVEL_STEP = 0.0085, 0.016  # what the expert covers per step in the sweep and elsewhere, for what follows
# What it needs from the touch until the fingers hold, to lift, to release.
GRASP_STEPS, LIFT_STEPS, PLACE_STEPS = 25, 5, 30
SLACK_STEPS = 3  # it takes over when it has only so many steps more than it needs

SEARCH, GRASP, LIFT, CARRY = range(4)
_STAGES = {
    **dict.fromkeys(("retreat", "approach", "lower", "sweep"), SEARCH),
    **dict.fromkeys(("dwell", "rise", "hover", "hop", "descend", "grasp"), GRASP),
    **dict.fromkeys(("lift", "hold"), LIFT),
    **dict.fromkeys(("bring_back", "carry", "release"), CARRY),
}


class InterventionGate(StagedGate):
    """The gate of the tasks with a cube; see `StagedGate`."""

    stages = _STAGES
    still = (24, 0.005)

    def __init__(self, env, expert: GraspExpert):
        super().__init__(env, expert)
        self._on_top_for = 0  # steps
        self._was_held = self._was_up = False
        self._first_cube = self._lifted_at = env.position("cube")

    def act(self) -> np.ndarray:
        """The expert's action (4,) for the present state."""
        if self.expert.phase == "descend" and not self._is_open():
            self.expert.phase = "hop"  # fingers that the policy closed take their time to open: wait above the cube
        if self.expert.phase == "lower" and (self._hears() or not self._is_open()):
            self.expert.phase = "approach"  # a new search begins as the first did: in silence
        return super().act()

    # What there is to see

    def _look(self) -> None:
        if self.env.contact_forces["gripper-cube"] > self.expert.CONTACT_FORCE:
            self._touched_at = self._n_steps
        self._on_top_for = self._on_top_for + 1 if self._is_on_top() else 0
        if self._holds() and self._cube_height() > 0.01 and not self._was_held:
            self._was_held, self._lifted_at = True, self.env.position("cube")
        self._was_up |= self._holds() and self._height() > self._carry_height() - 0.01

    def _height(self) -> float:
        """Of the fingertips' middle above the table [m]."""
        return float(self.env.eef_position[2] - TABLE_TOP)

    def _cube_height(self) -> float:
        """How far the cube was lifted [m]."""
        return float(self.env.position("cube")[2] - self._first_cube[2])

    def _offset(self) -> np.ndarray:
        """(3,) from the hand to the cube [m]."""
        return self.env.position("cube") - self.env.eef_position

    def _is_between(self) -> bool:
        """Whether fingers that close now would take the cube."""
        near = np.abs(self._offset()[:2]).max() < GRASP_REACH
        return bool(near and (self._height() < GRASP_HEIGHT or self._cube_height() > 0.01))

    def _is_open(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.env.definition.arm.max_opening - 0.004)

    def _holds(self) -> bool:
        squeezed = self.env.contact_forces["gripper-cube"] > 0.5 * self.expert.SQUEEZE_FORCE
        return bool(squeezed and not self._is_open() and np.abs(self._offset()).max() < 0.03)

    def _touches(self) -> bool:
        return self._touched_at is not None and self._n_steps - self._touched_at < 3

    def _hears(self) -> bool:
        """Whether the policy can still hear the last touch."""
        return self._touched_at is not None and self._n_steps - self._touched_at <= MEMORY_STEPS

    def _is_over_tray(self) -> bool:
        tray = self.env.shown.get("bin_position")
        return tray is not None and bool(np.abs(self.env.position("cube") - tray)[:2].max() < RELEASE_REACH)

    def _carry_height(self) -> float:
        """The lowest at which the expert carries [m above the table]; infinite where nothing is carried."""
        return getattr(self.expert, "CARRY_HEIGHT", (np.inf,))[0]

    def _before_cube(self) -> bool:
        """Whether a sweep from here can still touch the cube."""
        return self._offset()[1] > self.expert.reach - 0.003

    # When to take over

    def _find_reason(self, action: np.ndarray) -> str | None:
        if self._was_held and self._is_over_tray():
            return "still" if self._is_still() and not self.env.is_as_wanted else None
        holds = self._holds()
        checks = {
            "pushes": self._drags(action) if holds else self._pushes(action),
            "lands": not holds and self._lands(action),
            "landed": self._on_top_for > LANDED_STEPS,
            "empty": not holds and self.env.finger_positions.sum() < EMPTY_OPENING,
            "misplaces": holds and self._misplaces(),
            "opens": holds and action[3] <= 0 and not self.env.gripper_blocked_steps,
            "dropped": not holds and self._was_held and np.linalg.norm(self._offset()) > DROP_DISTANCE,
            "missed": not holds and not self._was_held and self._missed(),
            "strayed": not holds and self._strayed(),
            "hovers": not holds and self._hovers(action),
            "still": self._is_still(),
            "late": self._is_late(),
        }
        return next((reason for reason, applies in checks.items() if applies), None)

    def _pushes(self, action: np.ndarray) -> bool:
        """Goes on pushing a cube that it has touched."""
        towards = action[1] * ACTION_SCALE * np.sign(self._offset()[1]) > PUSH_STEP
        return bool(self._touches() and towards and not self._is_between() and self._is_shoved())

    def _drags(self, action: np.ndarray) -> bool:
        """Holds the cube and does not lift it, but moves it along the table."""
        along, up = np.linalg.norm(action[:2]) * ACTION_SCALE, action[2] * ACTION_SCALE
        lifts = self._cube_height() > 0.01 or up > PUSH_STEP
        return bool(along > 1.5 * PUSH_STEP and not lifts and self._is_shoved())

    def _misplaces(self) -> bool:
        """Has carried the cube past the tray, or lowers it beside the tray."""
        if not self._was_up or not self._is_far():
            return False
        tray = self.env.shown["bin_position"]
        way, left = (place[1] - tray[1] for place in (self._lifted_at, self.env.position("cube")))
        past = np.sign(way) * left < -CARRY_PAST
        lowers = self._height() < self._carry_height() - CARRY_SINK
        return bool(past or (lowers and not self._is_over_tray()))

    def _is_far(self) -> bool:
        """Whether the cube is a good way from where it was lifted."""
        return bool(np.linalg.norm((self.env.position("cube") - self._lifted_at)[:2]) > FAR)

    def _brings_back(self) -> bool:
        """Whether the way to the tray is to be shown again: the policy has gone most of it, and there is time."""
        tray = self.env.shown.get("bin_position")
        if tray is None or not (self._holds() and self._is_far()):
            return False
        back, way = (abs(place[1] - self._lifted_at[1]) for place in (self.env.position("cube"), tray))
        needed = back / self.expert.BRING_BACK_STEP + way / TRAVEL_STEP + PLACE_STEPS + SLACK_STEPS
        has_time = self.env._max_episode_steps - self._n_steps > needed
        return bool(has_time and (self.reason in ("opens", "misplaces") or self._misplaces()))

    def _is_shoved(self) -> bool:
        moved = np.linalg.norm((self.env.position("cube") - self._first_cube)[:2])
        return bool(moved > SHOVE_SHARE * MAX_SHOVE)

    def _is_on_top(self) -> bool:
        """Whether the hand came down on the cube instead of around it."""
        over = np.abs(self._offset()[:2]).max() < self.expert.reach - 0.01
        too_high = GRASP_HEIGHT < self._height() < self.expert.CLEAR_HEIGHT - 0.01
        return bool(over and too_high and self._touches() and not self._holds())

    def _lands(self, action: np.ndarray) -> bool:
        """Is about to come down on the cube where that ends the attempt."""
        if action[2] >= 0:
            return False
        across, along = np.abs(self._offset()[:2])
        fits = self.env.finger_positions.sum() / 2 - CUBE_HALF_SIZE
        is_over = across < LAND_X and fits < along < self.expert.reach
        above = self._height() - LAND_HEIGHT
        return bool(is_over and 0 <= above < LAND_MARGIN - action[2] * ACTION_SCALE)

    def _missed(self) -> bool:
        """High above the table without the cube, although it was touched or should have been."""
        has_searched = self._n_steps > SEARCH_SHARE * self.env._max_episode_steps
        past = self._touched_at is not None and self._offset()[1] < -HOP_PAST
        high = self._height() > MISSED_HEIGHT
        return past or (high and (self._touched_at is not None or has_searched))

    def _strayed(self) -> bool:
        """Searches where the cube cannot be."""
        if self._touched_at is not None or self._height() > 0.05:
            return False
        x, y, _ = self.env.eef_position
        beside = abs(x - LINE_X) > STRAY_X
        return bool(beside or not self._before_cube() or y < self.expert.sweep_start - STRAY_Y)

    def _hovers(self, action: np.ndarray) -> bool:
        """Late, close to the cube, and does not know what to do."""
        is_late = self._n_steps > HOVER_SHARE * self.env._max_episode_steps
        near = np.linalg.norm(self._offset()) < HOVER_DISTANCE
        if not (is_late and near and self._is_open()) or self._last_action is None:
            return False
        return bool(np.abs(action - self._last_action).max() < HOVER_CHANGE)

    def _is_late(self) -> bool:
        """Has only as many steps left as the expert needs. What comes after a touch is judged by its result."""
        left = self.env._max_episode_steps - self._n_steps
        is_grasping = self._hears() and not self._holds()
        return not is_grasping and left <= self._steps_needed() + SLACK_STEPS

    def _steps_needed(self) -> float:
        """How many steps the expert needs from here, roughly."""
        expert, tray = self.expert, self.env.shown.get("bin_position")
        needed = float(LIFT_STEPS)
        if tray is not None:
            needed += PLACE_STEPS + abs(self.env.position("cube") - tray)[1] / TRAVEL_STEP
        if self._holds():
            return needed
        needed += GRASP_STEPS
        start = np.array([LINE_X, expert.sweep_start, TABLE_TOP + expert.SWEEP_HEIGHT])
        sweeps_from = expert.sweep_start
        if self._can_sweep():
            sweeps_from = self.env.eef_position[1]
        else:
            needed += np.abs(start - self.env.eef_position).sum() / TRAVEL_STEP
        return needed + max(0.0, self.env.position("cube")[1] - expert.reach - sweeps_from) / SEARCH_STEP

    # Where to begin

    def _take_over(self) -> None:
        """Starts the expert in the phase that fits what the hand is doing, until the stage that went wrong is done."""
        brings_back, phase = self._brings_back(), self._fitting_phase()
        self._was_held, self._was_up = self._holds(), False
        self.expert.begin_at(phase)
        if brings_back:
            self.expert.bring_back(float(self._lifted_at[1]))
        is_searching = self._touched_at is None and self.reason != "late"
        self._hands_back_at = GRASP if is_searching else max(LIFT, _STAGES[phase] + 1)
        if self.reason in ("opens", "misplaces") or brings_back:
            self._hands_back_at = CARRY + 1  # never: whoever shows where not to let go also shows where to

    def _fitting_phase(self) -> str:
        if self._holds():
            high = self._height() > self._carry_height() - 0.01
            return "release" if self._is_over_tray() else "carry" if high else "lift"
        if self._is_between() and self._is_open() and self._hears():
            return "grasp"
        if self._touches() and self._is_low() and self._offset()[1] > self.expert.reach - 0.01:
            return "dwell"
        return self._fitting_search_phase()

    def _fitting_search_phase(self) -> str:
        start = np.array([LINE_X, self.expert.sweep_start])
        if self._can_sweep():
            return "sweep"
        if np.linalg.norm(self.env.eef_position[:2] - start) < 0.02:
            return "lower"
        is_low = self._height() < self.expert.TRAVEL_HEIGHT - 0.02
        return "retreat" if is_low and not self._before_cube() else "approach"

    def _can_sweep(self) -> bool:
        """Whether the hand is on the line of the sweep, before the cube, and has not just touched it."""
        x, y, _ = self.env.eef_position
        on_line = abs(x - LINE_X) < 0.015 and y > self.expert.sweep_start - STRAY_Y
        return bool(on_line and self._is_low() and self._before_cube() and not self._hears())

    def _is_low(self) -> bool:
        return self._height() < self.expert.SWEEP_HEIGHT + 0.012
