"""Environment steps per second, picture and sound included, in one process and in two, beside robosuite.

    python benchmarks/environment.py

robosuite needs other versions than ours: it is installed into an environment of its own in `outputs/`, and is left out where
that is impossible, or with `--alone`. All processes stay open and work in turns: random actions, resets included, medians. The
limits are the parts of a step that cannot be left out: physics, and the picture's pixels.
"""

import argparse
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
from common import Helper, Row, in_turns, medians, parser_for, run

import gym_playbyear  # noqa: F401

os.environ.setdefault("MUJOCO_GL", "egl")
_ANSWER = """
import sys, time
import numpy as np
def answer(step, reset, shape):
    reset()
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (500, *shape)).astype(np.float32)
    i = 0
    for line in sys.stdin:
        start, n = time.perf_counter(), int(line)
        for _ in range(n):
            i += 1
            if step(actions[i % len(actions)]):
                reset()
        print("answer", n / (time.perf_counter() - start), flush=True)
"""
_OURS = """
import gymnasium as gym, gym_playbyear
env = gym.make("gym_playbyear/{task}")
env.reset(seed=0)
answer(lambda action: any(env.step(action)[2:4]), env.reset, (4,))
"""
_PACKAGES = ("robosuite==1.5.2", "mujoco==3.3.7", "numpy<2.3")
_ROBOSUITE = """
import logging
logging.disable(logging.CRITICAL)
import robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=True, use_camera_obs=True,
    camera_names="agentview", camera_heights=84, camera_widths=84, control_freq=20, horizon=100000)
answer(lambda action: env.step(action)[2], env.reset, (env.action_dim,))
"""


def parts_of_a_step(env) -> dict[str, Callable[[], object]]:
    """What a step consists of, each alone."""
    hold = np.repeat(env.data.ctrl[None].copy(), env._controller.n_substeps, axis=0)
    return {
        "physics": lambda: env._roll(hold),
        "picture": lambda: env._picture("front", 84),
        "sound": env.listen,
        "inverse kinematics": lambda: env._controller.command(np.zeros(4), env.eef_position),
    }


def robosuite() -> list[Helper]:
    """robosuite in an environment of its own, which is made where it is missing; none where it does not run."""
    folder = Path("outputs/robosuite")
    python = str(folder / "bin" / "python")
    try:
        if not Path(python).exists():
            subprocess.run([sys.executable, "-m", "venv", folder], check=True)
            subprocess.run([python, "-m", "pip", "install", "--quiet", *_PACKAGES], check=True)
        helper = Helper(python, "-c", _ANSWER + _ROBOSUITE)
        together([helper], 5)
        return [helper]
    except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
        print(f"robosuite does not run here and is left out: {str(error)[-500:]}", file=sys.stderr)
        return []


def together(helpers: list[Helper], n_steps: int) -> float:
    """Steps per second of several processes at once, added up."""
    for helper in helpers:
        helper.ask(str(n_steps))
    return sum(helper.answer() for helper in helpers)


def measure(args: argparse.Namespace) -> list[Row]:
    ours = [Helper(sys.executable, "-c", _ANSWER + _OURS.format(task=args.task)) for _ in range(2)]
    together(ours, 20)
    theirs = [] if args.alone else robosuite()
    rates: dict[str, list[float]] = defaultdict(list)
    for _ in range(args.turns):
        rates["one"].append(together(ours[:1], args.steps))
        rates["two"].append(together(ours, args.steps))
        if theirs:
            rates["robosuite"].append(together(theirs, max(20, args.steps // 10)))
    for helper in [*ours, *theirs]:
        helper.close()
    middle = medians(rates)
    env = gym.make(f"gym_playbyear/{args.task}").unwrapped
    env.reset(seed=0)
    parts = medians(in_turns(parts_of_a_step(env), 200, warm_up=10))
    beside = ("robosuite 1.5.2 Lift, one 84 px camera, no sound", middle["robosuite"]) if theirs else ("", None)
    limit = ("physics and picture alone", 1 / (parts["physics"] + parts["picture"]))
    name = f"{args.task}, picture and sound, {middle['one'] / env.control_hz:.1f} times real time"
    return [
        Row(name, middle["one"], "steps/s", *beside, *limit),
        Row(f"{args.task}, two processes", middle["two"], "steps/s", "one process", middle["one"]),
        *(Row(f"of a step: {part}", 1e3 * seconds, "ms") for part, seconds in parts.items()),
    ]


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--steps", type=int, default=500, help="of a turn")
    parser.add_argument("--alone", action="store_true", help="without robosuite")
    run(parser, measure)
