"""How often the scripts succeed that know everything the camera shows, and cannot hear.

    python examples/blind_floor.py --task=OccludedGrasp-v0 --episodes=20

Whatever a policy reaches beyond this, it reaches by listening. Plain Gymnasium: no LeRobot, no torch.
"""

import argparse
import json
from pathlib import Path

import gymnasium as gym

import gym_playbyear  # noqa: F401  (registers the tasks)


def success_rate(env: gym.Env, name: str, seeds: range) -> float:
    """The share of `seeds` on which the blind baseline `name` solves the task."""
    solved = 0
    for seed in seeds:
        env.reset(seed=seed)
        script = env.unwrapped.blind_baselines()[name]
        ended = False
        while not ended:
            _, _, terminated, truncated, info = env.step(script.act())
            ended = terminated or truncated
        solved += info["is_success"]
    return solved / len(seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="OccludedGrasp-v0")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000, help="of the first episode")
    parser.add_argument("--output", type=Path, help="a JSON file for the rates")
    args = parser.parse_args()

    env = gym.make(f"gym_playbyear/{args.task}")
    env.reset(seed=args.seed)
    seeds = range(args.seed, args.seed + args.episodes)
    rates = {name: success_rate(env, name, seeds) for name in env.unwrapped.blind_baselines()}
    env.close()
    for name, rate in rates.items():
        print(f"{name:24s} {rate:4.0%} of {args.episodes} episodes")
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(rates, indent=2) + "\n")


if __name__ == "__main__":
    main()
