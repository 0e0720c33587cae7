"""What those reach who hear and do not see: the scripted expert, told guesses instead of what the camera shows.

    python -m experiments.sightless

For comparison with policies without pictures (`use_vision=false`). From a touch on, the expert knows where the cube is, as it
always does. In which half of the table the cube lies and where the tray stands it does not know:

- `guess`: it takes them from the picture of another episode, whose number is drawn at random;
- `everywhere`: it searches the whole table, and lets go above the middle of where the tray may stand.
"""

from typing import Any

import gymnasium as gym
import numpy as np

import gym_playbyear  # noqa: F401  registers the tasks
from experiments.protocol import EVALUATION_SEEDS, RESULTS, command_line, save
from gym_playbyear.tasks.occluded import BIN_Y, BIN_Y_RANGE

STUDY = "sightless"
TASKS = ("OccludedGrasp-v1", "OccludedPickPlace-v1")
SHOWN = ("hidden_range", "bin_position")
_OTHER_EPISODES = range(90000, 91000)


class Mistold:
    """An environment for a script that cannot see: what the camera shows is replaced, the rest is as it is.

    Args:
        env: The unwrapped environment.
        told: What the script takes the picture to show, by name.
    """

    def __init__(self, env: Any, told: dict[str, Any]):
        self._env, self._told = env, told

    def __getattr__(self, name: str) -> Any:
        return self._told[name] if name in self._told else getattr(self._env, name)


def guess(env: Any, rng: np.random.Generator) -> dict[str, Any]:
    """What another episode's picture shows."""
    env.reset_physics(seed=int(rng.choice(_OTHER_EPISODES)))
    return {name: env.shown[name] for name in SHOWN if name in env.shown}


def everywhere(env: Any, _: np.random.Generator) -> dict[str, Any]:
    """All places of the cube, and the middle of those of the tray."""
    middle = np.array([0.0, BIN_Y - BIN_Y_RANGE / 2, env.position("bin")[2]]) if "bin_position" in env.shown else None
    return {"hidden_range": env.definition.numbers.cube_y} | ({} if middle is None else {"bin_position": middle})


SCRIPTS = {"guess": guess, "everywhere": everywhere}


def attempts(task: str, script: str, seeds: range) -> list[str]:
    """How each seed's attempt ended, `info["end"]`."""
    env = gym.make(f"gym_playbyear/{task}", sound="none")
    task_env: Any = env.unwrapped
    rng, ends = np.random.default_rng(0), []
    for seed in seeds:
        task_env.reset_physics(seed=seed)
        told = SCRIPTS[script](task_env, rng)
        task_env.reset_physics(seed=seed)
        expert = task_env.definition.expert(Mistold(task_env, told))
        done = False
        while not done:
            _, terminated, truncated, info = task_env.step_physics(expert.act())
            done = terminated or truncated
        ends.append(info["end"])
    env.close()
    return ends


def main() -> None:
    command_line(__doc__).parse_args()
    for task in TASKS:
        ends = {script: attempts(task, script, EVALUATION_SEEDS) for script in SCRIPTS}
        successes = {script: sum(end == "success" for end in of) for script, of in ends.items()}
        save(
            RESULTS / STUDY / f"{task}.json",
            {
                "task": task,
                "first_seed": EVALUATION_SEEDS.start,
                "ends": ends,
                "command": "python -m experiments.sightless",
            },
        )
        print(f"{task}, {len(EVALUATION_SEEDS)} episodes: {successes}", flush=True)


if __name__ == "__main__":
    main()
