"""When the expert takes over from a policy that takes things out of a bag, and when it hands back.

As for the other tasks (`gym_playbyear.gates`), a gate waits until a mistake can be noticed, and hands back when the
expert's own phase changes: from searching to grasping, and from grasping to lifting.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.arm import ACTION_SCALE
from gym_playbyear.bag import BAG, RIM, bottom_height
from gym_playbyear.bag_contents import CONTENTS, middle_of
from gym_playbyear.bag_experts import TIP_BELOW_HAND, BagExpert
from gym_playbyear.staged_gate import StagedGate

SEARCH, GRASP, LIFT = range(3)
_STAGES = {
    **dict.fromkeys(("enter", "descend", "search"), SEARCH),
    **dict.fromkeys(("dwell", "rise", "centre", "lower", "grasp"), GRASP),
    **dict.fromkeys(("lift", "hold"), LIFT),
}


@dataclass(frozen=True)
class BagGateConfig:
    """Thresholds. Lengths in metres, durations in control steps, forces in newtons.

    push_force, push_step: the hand presses this hard, and would go on by at least so much; empty_steps: for so long the
    fingers hold nothing; memory_steps: how long a touch is heard; missed_height: the hand is so far above the bag's bottom
    after it; still_steps, still_distance: the hand moved less in so many steps; search_steps: left of the episode without a
    touch; grasp_steps: left without a grasp.
    """

    push_force: float = 12.0
    push_step: float = 0.003
    empty_steps: int = 2
    memory_steps: int = 10
    missed_height: float = 0.07
    still_steps: int = 18
    still_distance: float = 0.01
    search_steps: int = 48
    grasp_steps: int = 38


class BagGate(StagedGate):
    """The gate of the bag; see `StagedGate`."""

    stages = _STAGES

    def __init__(self, env, expert: BagExpert, config: BagGateConfig | None = None):
        super().__init__(env, expert, config or BagGateConfig())
        self._empty_for, self._height_at_touch = 0, 0.0
        self._places: list[np.ndarray] = []

    def _look(self) -> None:
        if self.env.contact_forces[f"gripper-{CONTENTS}"] > self.expert.config.contact_force:
            self._touched_at, self._height_at_touch = self._n_steps, float(self.env.eef_position[2])
        empty = self.env.finger_positions.sum() < self.expert.config.empty
        self._empty_for = self._empty_for + 1 if empty else 0
        self._places = [*self._places[-self.config.still_steps :], self.env.eef_position]

    def _height(self) -> float:
        """Of the fingers' tips above the bag's bottom [m]."""
        return float(self.env.eef_position[2] - TIP_BELOW_HAND - bottom_height(self.env))

    def _holds(self) -> bool:
        closed = self.env.finger_positions.sum() < self.env.variant.arm.max_opening - 0.006
        return bool(closed and self.env.contact_forces[f"gripper-{CONTENTS}"] > 2.0 and not self._empty_for)

    def _find_reason(self, action: np.ndarray) -> str | None:
        left, forces = self.env._max_episode_steps - self._n_steps, self.env.contact_forces
        touched = None if self._touched_at is None else self._n_steps - self._touched_at
        if self._holds():
            opens = action[3] <= 0 and self.env.gripper_obeys
            return "opens" if opens else "still" if self._is_still() else None
        pressed = max(forces[f"gripper-{CONTENTS}"], forces[f"gripper-{BAG}"]) > self.config.push_force
        checks = {
            "pushes": pressed and action[2] * ACTION_SCALE < -self.config.push_step,
            "empty": self._empty_for > self.config.empty_steps,
            "missed": touched is not None and touched > 3 and self._height() > self.config.missed_height,
            "still": self._is_still(),
            "late": left <= (self.config.search_steps if touched is None else self.config.grasp_steps),
        }
        return next((reason for reason, applies in checks.items() if applies), None)

    def _is_still(self) -> bool:
        is_full = len(self._places) > self.config.still_steps
        return is_full and bool(np.linalg.norm(self._places[-1] - self._places[0]) < self.config.still_distance)

    def _take_over(self) -> None:
        """Starts the expert in the phase that fits what the hand is doing, until the stage that went wrong is done."""
        self._places = []
        heard = self._touched_at is not None and self._n_steps - self._touched_at <= self.config.memory_steps
        if self._holds():
            self.expert.begin_at("lift")
        elif heard:
            self.expert.begin_at("rise", self._heard_place(), self._height_at_touch)
        elif self._empty_for:
            self.expert.begin_at("rise")
            self.expert.try_elsewhere()  # where it closed is nothing
        else:
            self.expert.begin_at("enter" if self.env.eef_position[2] > RIM else "descend")
        self._hands_back_at = LIFT + 1 if self.reason == "opens" else _STAGES[self.expert.phase] + 1

    def _heard_place(self) -> np.ndarray:
        """(2,) the middle of where the things may lie on their side [m, world]: who heard a touch knows no more."""
        things = middle_of(self.env)[:2]
        return min(self.env.variant.middles, key=lambda middle: float(np.linalg.norm(middle - things)))

    def _follow(self) -> None:
        phase, stage = self.expert.phase, _STAGES[self.expert.phase]
        if self._holds() and stage < LIFT:
            self.expert.begin_at("lift")
        elif phase == "enter" and self.env.eef_position[2] <= RIM:
            self.expert.begin_at("descend")
        elif stage == SEARCH and phase != "enter" and self.env.eef_position[2] > RIM:
            self.expert.begin_at("enter")
