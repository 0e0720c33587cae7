"""The tasks in plain Gymnasium, without LeRobot and torch: the expert acts, and the frame in which it touches is printed.

MUJOCO_GL=egl python examples/play_in_gymnasium.py --task=OccludedGrasp-v1
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import gym_playbyear  # noqa: F401  (registers the tasks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    env = gym.make(f"gym_playbyear/{args.task}")
    env.reset(seed=args.seed)
    task: Any = env.unwrapped
    expert = task.scripted_expert()
    ended, step = False, 0
    while not ended:
        observation, _, terminated, truncated, info = env.step(expert.act())
        level = 10 * np.log10(np.mean((observation["audio.gripper"] / 32768.0) ** 2) + 1e-12)
        if level > -40:
            print(f"step {step:3d}, {expert.phase:8s} {level:6.1f} dB re full scale")
        step += 1
        ended = terminated or truncated
    env.close()
    print(f"{'Solved' if info['is_success'] else 'Not solved'} after {step} steps")


if __name__ == "__main__":
    main()
