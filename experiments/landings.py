"""Where does the hand come down? How far beside the hidden cube, and after how long a hop.

    python -m experiments.landings --task=OccludedGrasp-v1 --checkpoint=outputs/train/checkpoints/last/pretrained_model
    python -m experiments.landings --task=OccludedGrasp-v1          # the expert's

A hop begins with the first touch. It ends when the hand has fallen by 12 mm, after it was 3 cm higher than at the touch.
The episodes are of seeds on which choices are made. Prints a line per episode, and the mean of those that end alike and of all.
"""

from argparse import ArgumentParser, Namespace
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.listening import actor_of
from experiments.lottery import CHOICE_SEEDS
from experiments.protocol import NEW_TASKS, TASKS, command_line
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import Actor, play
from lerobot_playbyear.episodes.pool import Script

TOUCH_N = 0.2  # a touch, and not the noise of a contact [N]
RISE_M, FALL_M = 0.03, 0.012
CUBES = TASKS + NEW_TASKS[:2]


@dataclass(frozen=True)
class Landing:
    """One hop.

    Attributes:
        offset_mm: How far the hand was beyond the cube's middle, along the sweep, when the hop ended.
        way_mm: How far it was then from where it had touched the cube.
        n_steps: From the touch on.
    """

    offset_mm: float
    way_mm: float
    n_steps: int


class HopRecorder(gym.Wrapper):
    """Notes hand, cube and force in every step of an episode of a cube task."""

    def reset(self, **options: Any) -> Any:
        self._steps: list[tuple[float, ...]] = []
        self.end = ""
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        result, world = super().step(action), self.env.unwrapped
        hand, cube = world.eef_position, world.cube_position  # type: ignore[attr-defined]
        self._steps.append((hand[1], hand[2], cube[1], world.contact_forces["gripper-cube"]))  # type: ignore[attr-defined]
        self.end = result[-1].get("end", "")
        return result

    def landing(self) -> Landing | None:
        """The first hop's; None: nothing was touched, or the hand never came down again."""
        y, z, cube_y, force = np.array(self._steps).T
        touches = np.flatnonzero(force > TOUCH_N)
        if not len(touches):
            return None
        touch = int(touches[0])
        highest = np.maximum.accumulate(z[touch:])
        down = np.flatnonzero((highest > z[touch] + RISE_M) & (z[touch:] < highest - FALL_M))
        if not len(down):
            return None
        end = touch + int(down[0])
        return Landing(float(1000 * (y[end] - cube_y[end])), float(1000 * (y[end] - y[touch])), end - touch)


def parser_of(doc: str | None, task: str, n_episodes: int, tasks: tuple[str, ...] = CUBES) -> ArgumentParser:
    """Knows what `asked_for` needs.

    Args:
        doc: Of the module, which is its help.
        task, n_episodes: Where none is given.
        tasks: Those that can be asked for.
    """
    parser = command_line(doc)
    parser.add_argument("--task", choices=tasks, default=task)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--n_episodes", type=int, default=n_episodes)
    return parser


def asked_for(options: Namespace) -> tuple[gym.Env, Actor, range]:
    """What a command line asks for: the environment, who acts in it, and the seeds of the episodes."""
    config = PlaybyearEnvConfig(task=options.task)
    actor = actor_of(options.checkpoint, config) if options.checkpoint else Script()
    return env_spec(config).make(), actor, CHOICE_SEEDS[: options.n_episodes]


def main() -> None:
    env, actor, seeds = asked_for(parser_of(__doc__, CUBES[-2], n_episodes=30).parse_args())
    recorder, landings = HopRecorder(env), defaultdict(list)
    for seed in seeds:
        play(recorder, actor, seed)
        landing = recorder.landing()
        told = (
            f"{landing.offset_mm:.1f} mm beside, after {landing.way_mm:.1f} mm and {landing.n_steps} steps"
            if landing
            else "never came down"
        )
        print(seed, recorder.end, told, flush=True)
        if landing:
            for end in (recorder.end, "all"):
                landings[end].append(landing)
    recorder.close()
    for end, alike in landings.items():
        offsets = np.array([landing.offset_mm for landing in alike])
        steps = np.array([landing.n_steps for landing in alike])
        print(
            f"{end}: {len(alike)}, offset {offsets.mean():.1f} ± {offsets.std():.1f} mm, {steps.min()} to {steps.max()} steps"
        )


if __name__ == "__main__":
    main()
