"""What a learner is told of a task beside the arm: what the camera shows, the truth for its critic, and how far it has come.

One class for each kind of task: a thing that lies somewhere on the table, things in a bag, a pouch that is lifted and
dropped. All give as many numbers, so that the same player can learn any of them.
"""

from typing import Any

import numpy as np

from gym_playbyear.check.deaf import DeafTask
from gym_playbyear.experts.key_bag import finger_forces, has_two_ears
from gym_playbyear.tasks.arena import LINE_X, TABLE_TOP
from gym_playbyear.tasks.bag import BAG, CONTENTS, RIM, bottom_height, middle_of
from gym_playbyear.tasks.tell_apart import AWAY

N_SHOWN = 10
N_TRUTH = 8
_GRASP_HEIGHT = 0.022  # m: the hand above the table
_AROUND = 0.015  # m: so near above a thing the hand is over it
_SCREWS = "screws"


class Terms:
    """A thing on the table, such as the cube: found, grasped, lifted, and carried to the tray where there is one.

    Args:
        task: The task as a deaf player meets it.
    """

    grip = 10.0  # N: fingers that are closed and press this hard hold something
    grasp_height = _GRASP_HEIGHT

    def __init__(self, task: DeafTask):
        self.task = task
        self.name = next((prop.name for prop in task.env.definition.props if prop.hidden), "")

    @property
    def env(self) -> Any:
        return self.task.env

    def begin(self) -> None:
        """An episode begins."""
        self.first_place = self.place()

    def place(self) -> np.ndarray:
        """(3,) where the thing is [m, world]."""
        return np.asarray(self.env.position(self.name))

    def middle(self, shown: dict[str, np.ndarray]) -> np.ndarray:
        """(3,) a point that the camera shows, from which the hand's place is counted [m, world]."""
        return np.array([LINE_X, np.mean(shown["hidden_range"]), TABLE_TOP + 0.05])

    def shown(self, shown: dict[str, np.ndarray], hand: np.ndarray) -> list[float]:
        """At most `N_SHOWN` numbers of about unit size: what the camera shows, and the hand's height where it matters."""
        lower, upper = shown["hidden_range"]
        tray = shown.get("bin_position", np.array([0.0, lower, 0.0]))
        height = hand[2] - TABLE_TOP
        low = np.clip([(height - 0.03) / 0.02, (height - 0.05) / 0.005], -2, 2)
        return [hand[1], (lower + upper) / 2, upper - lower, tray[1] - hand[1], *low]

    def heard(self) -> np.ndarray:
        """(2,) how hard the hand touches what is hidden, and how hard anything else [N]."""
        forces = self.env.contact_forces
        elsewhere = [force for pair, force in forces.items() if pair.startswith("gripper-") and self.name not in pair]
        return np.array([self.task.touch_force, max(elsewhere, default=0.0)])

    def side(self) -> float:
        """On which side of the hand what is hidden was touched, from -1 to 1, where two ears tell; 1 where they need not."""
        return 1.0

    def truth(self, closes: bool) -> list[float]:
        """`N_TRUTH` - 1 numbers of about unit size that the player does not know."""
        place = self.place()
        moved = place - self.first_place
        aside = float(np.linalg.norm(moved[:2]))
        return [
            *(place - self.env.eef_position) / 0.05,
            moved[2] / 0.05,
            aside / 0.03,
            float(self.holds(closes)),
            float(np.log1p(self.task.touch_force)),
        ]

    def holds(self, closes: bool) -> bool:
        """Whether the closed fingers hold the thing."""
        near = np.linalg.norm(self.place() - self.env.eef_position) < 0.035
        return bool(closes and near and self.task.touch_force > self.grip)

    def worth(self, shown: dict[str, np.ndarray], closes: bool) -> float:
        """How far the attempt has come: the hand is over the thing, around it, holds it, lifts it, carries it."""
        place = self.place()
        worth = self._approach(place, self.env.eef_position, TABLE_TOP + self.grasp_height)
        if self.holds(closes):
            lifted = float(np.clip((place[2] - self.first_place[2]) / 0.05, 0, 1))
            worth += 1.0 + 2.0 * lifted
            tray = shown.get("bin_position")
            if tray is not None:
                worth += 2.0 * lifted * (1 - np.tanh(5 * float(np.linalg.norm((place - tray)[:2]))))
        return worth

    def _approach(self, place: np.ndarray, hand: np.ndarray, height: float) -> float:
        """From 0 to 2: the hand is over the thing, and then at the height of a grasp [m, world]."""
        aside = float(np.linalg.norm((place - hand)[:2]))
        down = float(np.clip(1 - (hand[2] - height) / 0.05, 0, 1)) if aside < _AROUND else 0.0
        return float(1.0 - np.tanh(8 * aside)) + down


class BagTerms(Terms):
    """Things in a bag: found, grasped, lifted out. The camera shows how the bag's walls bend."""

    grip = 2.0

    def place(self) -> np.ndarray:
        return middle_of(self.env)

    def middle(self, shown: dict[str, np.ndarray]) -> np.ndarray:
        return np.array([*shown["bag_middle"], TABLE_TOP + 0.08])

    def shown(self, shown: dict[str, np.ndarray], hand: np.ndarray) -> list[float]:
        return [*np.clip(shown["bag_bend"] / 0.1, -5, 5), (hand[2] - RIM) / 0.05]

    def heard(self) -> np.ndarray:
        forces = self.env.contact_forces
        return np.array([forces[f"gripper-{CONTENTS}"], forces[f"gripper-{BAG}"]])

    def side(self) -> float:
        left, right = finger_forces(self.env)
        return (right - left) / max(right + left, 1e-9) if has_two_ears(self.env) else super().side()

    def holds(self, closes: bool) -> bool:
        caught = self.env.finger_positions.sum() > 0.004
        return bool(closes and caught and self.task.touch_force > self.grip)

    def worth(self, shown: dict[str, np.ndarray], closes: bool) -> float:
        place = self.place()
        tips = 0.01  # m: the hand's point above the bottom while the tips are just over it
        worth = self._approach(place, self.env.eef_position, bottom_height(self.env) + tips)
        if self.holds(closes):
            way = RIM + 0.01 - self.first_place[2]
            worth += 1.0 + 3.0 * float(np.clip((place[2] - self.first_place[2]) / way, 0, 1))
        return worth


class PouchTerms(Terms):
    """A pouch: lifted, dropped, and then lifted again or left, as its contents ask for. Screws are heard, peanuts are not."""

    grip = 5.0
    grasp_height = 0.024

    def __init__(self, task: DeafTask):
        super().__init__(task)
        self.pieces, self.name = self.name.rstrip("0123456789"), "pouch"

    def middle(self, shown: dict[str, np.ndarray]) -> np.ndarray:
        return np.array([*shown["pouch_place"], TABLE_TOP + 0.05])

    def shown(self, shown: dict[str, np.ndarray], hand: np.ndarray) -> list[float]:
        pouch = shown["pouch_now"]
        height = (hand[2] - TABLE_TOP - 0.03) / 0.02
        return [
            *(pouch - hand) / 0.05,
            *shown["pouch_turn"],
            (pouch[2] - TABLE_TOP - 0.05) / 0.02,
            np.clip(height, -2, 2),
        ]

    def heard(self) -> np.ndarray:
        forces = self.env.contact_forces
        rattle = max(
            force for pair, force in forces.items() if pair.startswith(self.pieces) or f"-{self.pieces}" in pair
        )
        return np.array([rattle if self.env.secrets["contents"] == _SCREWS else 0.0, forces["gripper-pouch"]])

    def holds(self, closes: bool) -> bool:
        near = np.linalg.norm(self.place() - self.env.eef_position) < 0.035
        return bool(closes and near and self.env.contact_forces["gripper-pouch"] > self.grip)

    def truth(self, closes: bool) -> list[float]:
        known = super().truth(closes)
        return [
            *known[:4],
            float(self._was_dropped()),
            known[5],
            1.0 if self.env.secrets["contents"] == _SCREWS else -1.0,
        ]

    def worth(self, shown: dict[str, np.ndarray], closes: bool) -> float:
        """Over the pouch, around it, holds it, lifts it; 4 once it was dropped, and then the same again or away from it."""
        place, hand = self.place(), self.env.eef_position
        if self._was_dropped() and self.env.secrets["contents"] != _SCREWS:
            away = float(np.linalg.norm(place - hand)) / AWAY
            return 4.0 + 2.0 * min(away, 1.2)
        worth = 4.0 if self._was_dropped() else 0.0
        worth += 0.5 * self._approach(place, hand, TABLE_TOP + self.grasp_height)
        if self.holds(closes):
            worth += 1.0 + 1.5 * float(np.clip((place[2] - self.first_place[2]) / 0.06, 0, 1))
        return worth

    def _was_dropped(self) -> bool:
        return bool(self.env._success.course.was_dropped)


def terms_of(task: DeafTask) -> Terms:
    """What suits a task, after its episode began.

    Raises:
        ValueError: None of them does.
    """
    shown = task.env.camera_numbers()
    for key, terms in (("bag_bend", BagTerms), ("pouch_now", PouchTerms), ("hidden_range", Terms)):
        if key in shown:
            return terms(task)
    raise ValueError(
        f"task={task.env.task!r} shows {', '.join(shown) or 'nothing'} in numbers: a learner needs `hidden_range`, or terms of "
        "its own in examples/learned_adversary/numeric_terms.py."
    )
