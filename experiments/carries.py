"""How fast does a policy carry the cube, on the expert's way to the tray, and on its own?

    python -m experiments.carries --checkpoint=outputs/train/checkpoints/last/pretrained_model

A policy that knows where the tray is moves alike on both. One that repeats its last movement does what the expert does as long
as the expert moves the arm, and slows down by itself. The episodes are of seeds on which choices are made; they are played
twice. Prints a table: what each would do, on its way to the tray, in each range of what is left of the way.
"""

import itertools
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.landings import CUBES, asked_for, parser_of
from lerobot_playbyear.episodes.experts import ScriptedExpert
from lerobot_playbyear.episodes.play import Observation, play

TRAYS = tuple(task for task in CUBES if "PickPlace" in task)
EDGES_MM = (-10, 10, 30, 60, 100, 200, 300, 800)
UP_M = 0.05
"""A cube that is held so much higher than it was is being carried."""


class Companion(ScriptedExpert):
    """Looks on while a policy carries, or carries itself.

    Args:
        acts: Whether it acts in the policy's place, from the first step to the last.

    Attributes:
        rows: Of every step of a carry: what is left of the way [mm], the step towards the tray that the policy wants, and the
            one that was taken [% of the largest].
    """

    def __init__(self, acts: bool) -> None:
        self.acts = acts
        self.rows: list[list[float]] = []

    def reset(self, env: gym.Env) -> None:
        super().reset(env)
        self._world: Any = env.unwrapped
        self._first_z = float(self._world.cube_position[2])
        if self.acts:
            self.take_over()

    def wants_control(self, observation: Observation, policy_action: np.ndarray) -> bool:
        wants = self.acts and super().wants_control(observation, policy_action)
        world = self._world
        self._is_carried = world.contact_forces["gripper-cube"] > 0 and world.cube_position[2] > self._first_z + UP_M
        if self._is_carried:  # towards smaller y
            left = 1000 * float(world.cube_position[1] - world.bin_position[1])
            self.rows.append([left, *2 * [-100 * float(np.clip(policy_action[1], -1, 1))]])
        return wants

    def act(self) -> np.ndarray:
        action = super().act()
        if self._is_carried:
            self.rows[-1][2] = -100 * float(action[1])
        return action


def table_of(own: np.ndarray, shown: np.ndarray) -> str:
    """In Markdown, far from the tray first.

    Args:
        own, shown: `Companion.rows`, (n, 3), of carries by the policy and by the expert.
    """
    rows = [
        "| left of the way | the expert | the policy, on the expert's way | the policy, on its own |",
        "|---|---|---|---|",
    ]
    for low, high in reversed(list(itertools.pairwise(EDGES_MM))):
        cells = (_mean(shown, low, high, 2), _mean(shown, low, high, 1), _mean(own, low, high, 1))
        rows.append(f"| {low} to {high} mm | {' | '.join(cells)} |")
    return "\n".join(rows)


def _mean(rows: np.ndarray, low: float, high: float, column: int) -> str:
    values = rows[(rows[:, 0] >= low) & (rows[:, 0] < high), column]
    return f"{values.mean():.0f} ± {values.std():.0f} % ({len(values)})" if len(values) else "never there"


def main() -> None:
    env, actor, seeds = asked_for(parser_of(__doc__, TRAYS[-1], n_episodes=12, tasks=TRAYS).parse_args())
    tables = []
    for acts in (False, True):
        companion = Companion(acts)
        for seed in seeds:
            play(env, actor, seed, expert=companion)
        tables.append(np.array(companion.rows).reshape(-1, 3))
    env.close()
    print("The step towards the tray, in % of the largest, mean ± standard deviation (steps):\n")
    print(table_of(*tables))


if __name__ == "__main__":
    main()
