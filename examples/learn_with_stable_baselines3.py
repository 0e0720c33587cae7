"""A task in Stable-Baselines3: PPO on the picture, the arm and the sound of the last step.

    pip install stable-baselines3
    MUJOCO_GL=egl python examples/learn_with_stable_baselines3.py --task=OccludedGrasp-v1 --steps=1000000

It shows how the two fit together, not that it learns: a step's sound is short, the reward comes at the end, and this policy
remembers nothing. What has memory and imitates first: `examples/learned_adversary`.
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger

from gym_playbyear.wrappers import FlatObservation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--n_envs", type=int, default=1)
    parser.add_argument("--n_steps", type=int, default=2048, help="of each environment between two updates")
    parser.add_argument("--image_size", type=int, default=84)
    args = parser.parse_args()

    env = make_vec_env(
        f"gym_playbyear:gym_playbyear/{args.task}",
        n_envs=args.n_envs,
        seed=0,
        wrapper_class=FlatObservation,
        env_kwargs={"image_size": args.image_size},
    )
    model = PPO(
        "MultiInputPolicy", env, n_steps=args.n_steps, batch_size=min(64, args.n_steps * args.n_envs), device="cpu"
    )
    model.set_logger(Logger(folder=None, output_formats=[]))  # else it makes a folder in the system's temporary one
    model.learn(args.steps)
    env.close()
    print(f"{model.num_timesteps} steps of {args.task}; it observed {', '.join(env.observation_space.keys())}")


if __name__ == "__main__":
    main()
