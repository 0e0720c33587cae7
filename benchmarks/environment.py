"""Environment steps per second, picture and sound included, in one process and in two, beside other Panda simulators.

    python benchmarks/environment.py

robosuite and gym-hil need other versions than ours: each is installed into an environment of its own in `outputs/`, and is
left out where that is impossible (`--peers=` for none). All processes stay open and work in turns: random actions, resets
included, medians. The limits are the parts of a step that cannot be left out: physics, and the picture's pixels.
"""

import argparse
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from common import Helper, Row, in_turns, medians, parser_for, run

os.environ.setdefault("MUJOCO_GL", "egl")
WANTED_RATE, WANTED_REAL_TIME, WANTED_TIMES = 250, 8, 1.8  # steps/s at 20 Hz, times real time at 5 Hz, two processes
_ANSWER = """
import sys, time
import numpy as np
def answer(step, reset, low, high, shape):
    reset()
    actions = np.random.default_rng(0).uniform(low, high, (500, *shape)).astype(np.float32)
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
answer(lambda action: any(env.step(action)[2:4]), env.reset, -0.2, 0.2, (4,))
"""


class Peer(NamedTuple):
    """Another simulator: what it is, what it needs, and the program that steps it."""

    name: str
    packages: tuple[str, ...]
    code: str


_PEERS = {
    "robosuite": Peer(
        "robosuite 1.5.2 Lift, one 84 px camera, no sound",
        ("robosuite==1.5.2", "mujoco==3.3.7", "numpy<2.3"),
        """
import logging
logging.disable(logging.CRITICAL)
import robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=True, use_camera_obs=True,
    camera_names="agentview", camera_heights=84, camera_widths=84, control_freq=20, horizon=100000)
answer(lambda action: env.step(action)[2], env.reset, -0.2, 0.2, (env.action_dim,))
""",
    ),
    "gym-hil": Peer(
        "gym-hil 0.1.13 PandaPickCubeBase, two 128 px cameras, no sound",
        ("gym-hil==0.1.13", "mujoco==3.3.7"),
        """
import gymnasium as gym, gym_hil
env = gym.make("gym_hil/PandaPickCubeBase-v0", image_obs=True, render_mode="rgb_array")
env.reset(seed=0)
low, high = env.action_space.low, env.action_space.high
answer(lambda action: any(env.step(action)[2:4]), env.reset, 0.2 * low, 0.2 * high, low.shape)
""",
    ),
}


def make(task: str):
    """Our environment, after a reset."""
    import gymnasium as gym

    import gym_playbyear  # noqa: F401

    env = gym.make(f"gym_playbyear/{task}").unwrapped
    env.reset(seed=0)
    return env


def parts_of_a_step(env) -> dict[str, Callable[[], object]]:
    """What a step consists of, each alone."""
    import numpy as np

    hold = np.repeat(env.data.ctrl[None].copy(), env._controller.n_substeps, axis=0)
    camera, moment = env._cameras["front"], env.moment()
    return {
        "physics": lambda: env._advance(hold),
        "picture": lambda: camera.render(env.data, "front"),
        "sound": lambda: env._sound.step(env.model, moment),
        "inverse kinematics": lambda: env._controller.command(np.zeros(4), env.eef_position),
    }


def start(name: str) -> Helper | None:
    """Another simulator in an environment of its own, which is made where it is missing; None where it does not run."""
    folder = Path("outputs") / name.replace("-", "_")
    python = str(folder / "bin" / "python")
    try:
        if not Path(python).exists():
            subprocess.run([sys.executable, "-m", "venv", folder], check=True)
            subprocess.run([python, "-m", "pip", "install", "--quiet", *_PEERS[name].packages], check=True)
        helper = Helper(python, "-c", _ANSWER + _PEERS[name].code)
        helper.measure("5")
        return helper
    except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
        print(f"{name} does not run here and is left out: {str(error)[-500:]}", file=sys.stderr)
        return None


def together(helpers: list[Helper], n_steps: int) -> float:
    """Steps per second of several processes at once, added up."""
    for helper in helpers:
        helper.ask(str(n_steps))
    return sum(helper.answer() for helper in helpers)


def measure(args: argparse.Namespace) -> list[Row]:
    ours = [Helper(sys.executable, "-c", _ANSWER + _OURS.format(task=args.task)) for _ in range(2)]
    together(ours, 20)
    others = {name: helper for name in args.peers.split(",") if name and (helper := start(name))}
    rates: dict[str, list[float]] = defaultdict(list)
    for _ in range(args.turns):
        rates["one"].append(together(ours[:1], args.steps))
        rates["two"].append(together(ours, args.steps))
        for name, helper in others.items():
            rates[name].append(helper.measure(str(max(20, args.steps // 10))))
    for helper in [*ours, *others.values()]:
        helper.close()
    middle = medians(rates)
    env = make(args.task)
    parts = medians(in_turns(parts_of_a_step(env), 200, warm_up=10))
    one, two = middle["one"], middle["two"]
    kilohertz, least = (
        env._sample_rate / 1000,
        max(WANTED_RATE * (env.control_hz == 20), WANTED_REAL_TIME * env.control_hz),
    )
    rows = [
        Row(
            f"{args.task}, 84 px and {kilohertz:g} kHz, one process",
            one,
            "steps/s",
            *beside,
            limit_is="physics and picture alone",
            limit=1 / (parts["physics"] + parts["picture"]),
            wanted=f"at least {least}, {least / env.control_hz:g} times real time",
            holds=one >= least,
        )
        for beside in [(_PEERS[name].name, middle[name]) for name in others] or [()]
    ]
    wanted, holds = f"at least {WANTED_TIMES} times one", two >= WANTED_TIMES * one
    rows.append(
        Row(f"{args.task}, two processes", two, "steps/s", "one process", one, wanted=wanted, holds=holds),
    )
    rows += [Row(f"of a step: {name}", 1e3 * seconds, "ms") for name, seconds in parts.items()]
    return rows


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--task", default="OccludedGrasp-v1")
    parser.add_argument("--steps", type=int, default=500, help="of a turn")
    parser.add_argument("--peers", default=",".join(_PEERS), help="which of them to measure beside it")
    run("environment", parser, measure)
