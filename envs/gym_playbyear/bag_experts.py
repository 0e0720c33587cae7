"""Who takes things out of a bag: an expert that feels contact and knows where they are, and scripts that do neither.

The expert goes down until it feels something, searches along the bottom where it must, rises, centres, goes down around the
thing, closes, lifts and holds; after an empty grasp it tries again. Speeds, pauses and places are drawn anew for every episode.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.arena import TABLE_TOP
from gym_playbyear.arm import ACTION_SCALE, FINGER_THICKNESS, FINGER_WIDTH
from gym_playbyear.bag import BAG, RIM, bottom_height
from gym_playbyear.bag_contents import CONTENTS, points_of

TIP_BELOW_HAND = 0.0086  # m: how far the fingers' tips are below the point that is controlled
_GRIP, _ON_BAG = f"gripper-{CONTENTS}", f"gripper-{BAG}"
_OFFSETS = np.stack(np.meshgrid(*[np.arange(-0.04, 0.041, 0.005)] * 2), axis=-1).reshape(-1, 2)  # m: places to close at
_TALLEST = 0.02  # m: nothing in the bag is higher above its bottom


@dataclass(frozen=True)
class BagExpertConfig:
    """Where the expert moves and how much chance there is in it. Lengths in metres, durations in control steps.

    The pairs are ranges of uniform draws. fast, slow: displacement per step; pause_probability: per step of descent and search.
    """

    fast: tuple[float, float] = (0.020, 0.030)
    slow: tuple[float, float] = (0.0045, 0.0065)
    search_step: tuple[float, float] = (0.010, 0.014)
    pause_probability: float = 0.04
    pause: tuple[int, int] = (1, 2)
    dwell: tuple[int, int] = (0, 1)
    noise: float = 0.001
    contact_force: float = 0.15  # N
    bottom_force: float = 0.3  # N
    low: float = 0.008  # the tips above the bottom: fingers that close there take hold, too
    landed: float = 6.0  # N: the fingers came down on a thing, not around it
    aim: float = 0.005  # how far from the bag's middle it goes in
    hover: float = 0.025  # the tips above the bottom, on the way to a grasp
    above_bottom: float = 0.003  # the tips, in a search
    closing: int = 5
    empty: float = 0.004  # opening of fingers that hold nothing
    out: float = 0.055  # the hand above the rim, at the end


FOR_TALLER_THINGS = BagExpertConfig(hover=0.045)
"""For what is higher than a heap of keys: fingers that move to its place pass over it."""


class BagExpert:
    """Finds what is in the bag by touch, grasps it and lifts it out.

    Args:
        env: The unwrapped environment, after `reset`.
        config: Distances and randomness.
    """

    def __init__(self, env, config: BagExpertConfig | None = None):
        self.env, self.config = env, config or BagExpertConfig()
        self.rng: np.random.Generator = env.expert_rng
        draw = self.rng.uniform
        self.fast, self.slow, self.search_step = (
            draw(*limits) for limits in (self.config.fast, self.config.slow, self.config.search_step)
        )
        self.entry: np.ndarray = draw(-self.config.aim, self.config.aim, 2)
        self.turn = 1 if draw() < 0.5 else -1
        self.phase, self._wait, self._closed_for = "enter", 0, 0
        self._way: list[np.ndarray] = []
        self._aim, self._n_landed = self.entry, 0

    def begin_at(self, phase: str) -> None:
        """Goes on in the middle of an attempt: from where the hand is now, in `phase`."""
        self.phase, self._wait, self._closed_for = phase, 0, 0
        self.entry = self.env.eef_position[:2]

    def act(self) -> np.ndarray:
        """The action (4,) in [-1, 1] for the environment's present state."""
        goal, step, close = getattr(self, f"_{self.phase}")()
        displacement = np.zeros(3) if goal is None else goal - self.env.eef_position
        length = float(np.linalg.norm(displacement))
        if length > step:
            displacement *= step / length
        if goal is not None and self.phase != "hold":
            displacement = displacement + self.rng.uniform(-1, 1, 3) * self.config.noise
        return np.append(np.clip(displacement / ACTION_SCALE, -1, 1), 1.0 if close else -1.0).astype(np.float32)

    # One method per phase: it returns where to (3,) [m, world], or None to stay, how fast, and whether the fingers shall close.

    def _enter(self):
        upper = TABLE_TOP + self.env.variant.bottom[1] + _TALLEST + TIP_BELOW_HAND
        if self.env.eef_position[2] < upper + 0.005:
            self.phase = "descend"
        return np.array([*self.entry, upper]), self.fast, False

    def _descend(self):
        if self._feels_contents():
            return self._touched()
        if self._feels_bottom():
            if self._worth(self.env.eef_position[None, :2])[0] > 0.1:
                return self._begin_grasp()
            self._plan_search()
            return self._search()
        if self._pauses():
            return None, 0.0, False
        return np.array([*self.entry, TABLE_TOP]), self.slow, False

    def _plan_search(self) -> None:
        """Lines along y, along which the fingers open: a finger that moves so meets what lies before it."""
        self.phase = "search"
        reach = self.env.variant.offset[1] + 0.005
        x = self.env.eef_position[0]
        first, second = self.turn * 0.02, -self.turn * 0.02
        lines = [(x, reach), (x, -reach), (first, -reach), (first, reach), (second, reach), (second, -reach)]
        self._way = [np.array([a, self.turn * b]) for a, b in lines]

    def _search(self):
        if self._feels_contents():
            return self._touched()
        height = bottom_height(self.env) + TIP_BELOW_HAND + self.config.above_bottom
        if self._pauses():
            return None, 0.0, False
        if self._way and np.linalg.norm(self._way[0] - self.env.eef_position[:2]) < 0.004:
            self._way.pop(0)
        if not self._way:
            self._plan_search()
        return np.array([*self._way[0], height]), self.search_step, False

    def _touched(self):
        self.phase = "dwell"
        self._wait = int(self.rng.integers(*self.config.dwell, endpoint=True))
        return self._dwell()

    def _dwell(self):
        if self._has_waited():
            self.phase = "rise"
            return self._rise()
        return None, 0.0, False

    def _rise(self):
        height = bottom_height(self.env) + TIP_BELOW_HAND + self.config.hover
        if self.env.eef_position[2] > height - 0.004:
            self.phase, self._aim = "centre", self._best_place()
        return np.array([*self.env.eef_position[:2], height]), self.fast, False

    def _centre(self):
        goal = self._above(self.config.hover)
        if np.linalg.norm(goal - self.env.eef_position) < 0.004 and self._is_open():
            self.phase = "lower"
        return goal, self.fast, False

    def _lower(self):
        goal = self._above(-0.002)
        if self.env.contact_forces[_GRIP] > self.config.landed + min(self._n_landed, 4):  # with more force, if it must
            self._n_landed += 1
            low = self.env.eef_position[2] < self._above(self.config.low)[2]
            return self._begin_grasp() if low else self._touched()
        if self._feels_bottom() or self.env.eef_position[2] < goal[2] + 0.0015:
            return self._begin_grasp()
        return goal, float(np.clip(0.6 * (self.env.eef_position[2] - goal[2]), 0.004, 0.012)), False

    def _begin_grasp(self):
        self.phase, self._closed_for = "grasp", 0
        return self._grasp()

    def _grasp(self):
        self._closed_for += 1
        if self._closed_for > self.config.closing:
            self.phase = "rise" if self._is_empty() else "lift"
        height = bottom_height(self.env) + TIP_BELOW_HAND + 0.001  # less pressure on the bag, step by step
        return np.array([*self.env.eef_position[:2], height]), 0.002, True

    def _lift(self):
        if self._is_empty():
            self.phase = "rise"
            return None, 0.0, False
        height = RIM + self.config.out
        if self.env.eef_position[2] > height - 0.005:
            self.phase = "hold"
        return np.array([*self.env.eef_position[:2], height]), self.fast, True

    def _hold(self):
        return self._lift() if self._is_empty() else (None, 0.0, True)

    # What it feels and knows

    def _feels_contents(self) -> bool:
        return self.env.contact_forces[_GRIP] > self.config.contact_force

    def _feels_bottom(self) -> bool:
        low = self.env.eef_position[2] < bottom_height(self.env) + TIP_BELOW_HAND + 0.002
        return low and self.env.contact_forces[_ON_BAG] > self.config.bottom_force

    def _above(self, height: float) -> np.ndarray:
        return np.array([*self._aim, bottom_height(self.env) + TIP_BELOW_HAND + height])

    def _best_place(self) -> np.ndarray:
        """Where fingers that come down land on nothing, and most lies between them (2,) [m, world]."""
        middle = points_of(self.env)[:, :2].mean(axis=0)
        (low, high) = (np.array(corner)[:2] for corner in self.env.variant.arm.workspace)
        places = np.clip(middle + _OFFSETS, low, high)
        worth = self._worth(places) - 0.5 * np.linalg.norm(_OFFSETS, axis=1)
        worth += min(self._n_landed, 5) * 0.1 * self.rng.uniform(size=len(worth))  # elsewhere, after a bad landing
        return places[np.argmax(worth)]

    def _worth(self, places: np.ndarray) -> np.ndarray:
        """How good it is to close at some places (N, 2) [m, world]: the share of the things that is between the fingers,
        less what is under them (N,)."""
        points = points_of(self.env)
        across, along = np.abs(points[:, None, :2] - places).transpose(2, 0, 1)  # (P, N) each: x, y
        thick = np.clip((points[:, 2] - bottom_height(self.env)) / 0.01, 0.2, 1.0)[:, None]  # what is flat slips away
        inner = self.env.variant.arm.max_opening / 2
        between = (across < 0.007) & (along < inner - 0.004)
        under = (
            (across < FINGER_WIDTH / 2 + 0.002) & (along > inner - 0.003) & (along < inner + FINGER_THICKNESS + 0.003)
        )
        return np.asarray((between * thick).mean(axis=0) - 5.0 * under.mean(axis=0))

    def _is_open(self) -> bool:
        return bool(self.env.finger_positions.sum() > self.env.variant.arm.max_opening - 0.002)

    def _is_empty(self) -> bool:
        return bool(self.env.finger_positions.sum() < self.config.empty)

    def _pauses(self) -> bool:
        if self._wait == 0 and self.rng.random() < self.config.pause_probability:
            self._wait = int(self.rng.integers(*self.config.pause, endpoint=True))
        return not self._has_waited()

    def _has_waited(self) -> bool:
        """Whether the pause is over; if not, this is one step of it."""
        if self._wait == 0:
            return True
        self._wait -= 1
        return False


STRATEGIES = ("straight", "random", "spiral")


class BlindBag(BagExpert):
    """Goes to where it guesses that the things are, closes, and lifts what is between the fingers.

    `straight` goes down in the middle, first to a greater and then to a smaller height; `random` guesses place and height;
    `spiral` stays at the middle height and goes on along a spiral.

    Args:
        env: The unwrapped environment, after `reset`.
        strategy: One of `STRATEGIES`.
    """

    def __init__(self, env, strategy: str):
        super().__init__(env)
        self.strategy, self.n_attempts = strategy, 0
        self._guess()

    def _guess(self) -> None:
        (low, high), radius = self.env.variant.bottom, self.env.variant.offset[1]
        place, share = np.zeros(2), 0.5
        match self.strategy:
            case "straight":
                share = (2 / 3, 1 / 3)[self.n_attempts % 2]
            case "random":
                angle = self.rng.uniform(-np.pi, np.pi)
                place = radius * np.sqrt(self.rng.uniform()) * np.array([np.cos(angle), np.sin(angle)])
                share = self.rng.uniform()
            case "spiral":
                angle = 2.4 * self.n_attempts
                place = radius * np.sqrt(self.n_attempts / 3) * np.array([np.cos(angle), np.sin(angle)])
        height = TABLE_TOP + low + share * (high - low) + TIP_BELOW_HAND + 0.006
        self.guess = np.array([*place, height])
        self.n_attempts += 1
        self.phase = "rise"

    def _rise(self):
        height = TABLE_TOP + self.env.variant.bottom[1] + _TALLEST + TIP_BELOW_HAND
        goal = np.array([*self.guess[:2], height])
        if np.linalg.norm(goal - self.env.eef_position) < 0.004 and self._is_open():
            self.phase = "lower"
        return goal, 0.02, False

    def _lower(self):
        if np.linalg.norm(self.guess - self.env.eef_position) < 0.003:
            return self._begin_grasp()
        return self.guess, 0.012, False

    def _grasp(self):
        self._closed_for += 1
        if self._closed_for > self.config.closing:
            if self._is_empty():
                self._guess()
            else:
                self.phase = "lift"
        return None, 0.0, True

    def _lift(self):
        if self._is_empty():
            self._guess()
        return super()._lift()
