"""How often the expert and the blind baselines succeed: `python -m gym_playbyear.baselines --task OccludedGrasp-v1`."""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym

import gym_playbyear
from gym_playbyear.options import make_definition

EXPERT = "expert"


def success_rates(task: str, strategies: tuple[str, ...], seeds: range, **options) -> dict[str, float]:
    """Share of the seeds' episodes that each strategy solves.

    Args:
        task: Name of the task, such as `OccludedGrasp-v1`.
        strategies: `"expert"` and names of blind baselines.
        seeds: One episode each.
        options: For `gymnasium.make`.
    """
    env = gym.make(f"gym_playbyear/{task}", sound="none", **options)
    task_env: Any = env.unwrapped
    rates = {}
    for strategy in strategies:
        successes = 0
        for seed in seeds:
            task_env.begin_episode(seed=seed)
            is_expert = strategy == EXPERT
            actor = task_env.scripted_expert() if is_expert else task_env.blind_baselines()[strategy]
            done = False
            while not done:
                _, terminated, truncated, info = task_env.advance(actor.act())
                done = terminated or truncated
            successes += info["is_success"]
        rates[strategy] = successes / len(seeds)
    env.close()
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", nargs="+", default=list(gym_playbyear.TASKS))
    parser.add_argument("--n_episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000, help="of the first episode")
    parser.add_argument("--horizon", type=int, help="steps of an episode; by default the task's own")
    parser.add_argument("--output", type=Path, help="a JSON file for the rates")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.n_episodes)
    results = []
    scripts = {task: make_definition(task, {}).blind for task in arguments.task}  # all, before any plays
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
    for task, blind in scripts.items():
        rates = success_rates(task, (EXPERT, *blind), seeds, horizon=arguments.horizon)
        results.append({"task": task, "horizon": arguments.horizon, "seeds": [seeds[0], seeds[-1]], "success": rates})
        print(json.dumps(results[-1]), flush=True)
    if arguments.output:
        arguments.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
