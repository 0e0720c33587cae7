"""Memory and open files of a task's environment over thousands of episodes, and of forty environments made and closed.

    python benchmarks/episodes.py --task=OccludedGrasp-v1 --episodes=10000

Each episode is a reset and a few random steps, with picture and sound. Memory is what the process occupies after a tenth of the
episodes, by when all that is made once is there, and at the end. About ten minutes a task.
"""

import argparse
import os

import psutil
from common import Row, parser_for, run

os.environ.setdefault("MUJOCO_GL", "egl")
MOST_GROWTH = 16  # MiB: pages that the allocator has not given back yet come and go
N_CLOSED = 40


def occupied(process: psutil.Process) -> float:
    """MiB."""
    return process.memory_info().rss / 2**20


def play(env, n_steps: int) -> None:
    """A reset and some random steps."""
    env.reset()
    for _ in range(n_steps):
        if any(env.step(env.action_space.sample())[2:4]):
            return


def measure(args: argparse.Namespace) -> list[Row]:
    import gymnasium as gym

    import gym_playbyear  # noqa: F401

    process, name = psutil.Process(), f"gym_playbyear/{args.task}"
    env = gym.make(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    early = 0.0
    for episode in range(args.episodes):
        play(env, args.steps)
        if episode == args.episodes // 10:
            early = occupied(process)
    late = occupied(process)
    env.close()

    def make_and_close() -> None:
        other = gym.make(name)
        other.reset(seed=0)
        other.close()

    make_and_close()
    before, memory = process.num_fds(), occupied(process)
    for _ in range(N_CLOSED):
        make_and_close()
    after, more = process.num_fds(), occupied(process)
    growth, wanted = late - early, f"at most {MOST_GROWTH} MiB more"
    what = f"{args.task}, {args.episodes} episodes of {args.steps} steps"
    return [
        Row(f"{what}: memory", late, "MiB", "after a tenth", early, wanted=wanted, holds=growth <= MOST_GROWTH),
        Row(
            f"{N_CLOSED} environments made and closed: descriptors",
            after,
            "",
            "before",
            before,
            wanted="no more",
            holds=after <= before,
        ),
        Row(f"{N_CLOSED} environments made and closed: memory", more, "MiB", "before", memory),
    ]


if __name__ == "__main__":
    parser = parser_for(__doc__)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=5, help="of an episode")
    run("episodes", parser, measure)
