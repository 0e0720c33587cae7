"""Environment steps per second, picture and sound included, in one process and in two, beside other Panda simulators.

    python benchmarks/environment.py

robosuite and gym-hil need other versions than ours: each is installed into an environment of its own in `outputs/`, and is
left out where that is impossible (`--peers=` for none). All processes stay open and work in turns: random actions, resets
included, medians. The limits are the parts of a step that cannot be left out: physics, and the picture's pixels.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from common import Helper, Row, in_turns, machine, medians, parser_for, report, serve

os.environ.setdefault("MUJOCO_GL", "egl")
WANTED_RATE, WANTED_TIMES = 250, 1.8
_PEERS = {
    "robosuite": ("robosuite==1.5.2", "mujoco==3.3.7", "numpy<2.3"),
    "gym-hil": ("gym-hil==0.1.13", "mujoco==3.3.7"),
}
_NAMES = {
    "robosuite": "robosuite 1.5.2 Lift, one 84 px camera, no sound",
    "gym-hil": "gym-hil 0.1.13 PandaPickCubeBase, two 128 px cameras, no sound",
}
_ANSWER = """
import sys, time
def answer(step, reset, actions):
    i = 0
    for line in sys.stdin:
        start, n = time.perf_counter(), int(line)
        for _ in range(n):
            i += 1
            if step(actions[i % len(actions)]):
                reset()
        print("answer", n / (time.perf_counter() - start), flush=True)
"""
_CODE = {
    "robosuite": """
import logging
logging.disable(logging.CRITICAL)
import numpy as np, robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=True, use_camera_obs=True,
    camera_names="agentview", camera_heights=84, camera_widths=84, control_freq=20, horizon=100000)
env.reset()
actions = np.random.default_rng(0).uniform(-0.2, 0.2, (500, env.action_dim))
answer(lambda action: env.step(action)[2], env.reset, actions)
""",
    "gym-hil": """
import numpy as np, gymnasium as gym, gym_hil
env = gym.make("gym_hil/PandaPickCubeBase-v0", image_obs=True, render_mode="rgb_array")
env.reset(seed=0)
low, high = env.action_space.low, env.action_space.high
actions = np.random.default_rng(0).uniform(0.2 * low, 0.2 * high, (500, *low.shape)).astype(np.float32)
answer(lambda action: any(env.step(action)[2:4]), env.reset, actions)
""",
}


def serve_steps(task: str) -> None:
    """One environment of ours, in this process: steps per second [1/s]."""
    import gymnasium as gym
    import numpy as np

    import gym_playbyear  # noqa: F401

    env = gym.make(f"gym_playbyear/{task}")
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 4)).astype(np.float32)

    def rate(n_steps: str) -> float:
        start = time.perf_counter()
        for i in range(int(n_steps)):
            _, _, terminated, truncated, _ = env.step(actions[i % len(actions)])
            if terminated or truncated:
                env.reset()
        return int(n_steps) / (time.perf_counter() - start)

    serve(rate)


def parts_of_a_step(task: str) -> dict[str, Callable[[], object]]:
    """What a step consists of, each alone."""
    import gymnasium as gym
    import numpy as np

    import gym_playbyear  # noqa: F401

    env = gym.make(f"gym_playbyear/{task}").unwrapped
    env.reset(seed=0)
    hold = np.repeat(env.data.ctrl[None].copy(), env._controller.n_substeps, axis=0)
    camera, sensors = env._cameras["front"], env._rollout_sensors[0]
    from gym_playbyear.arena import pair_forces

    forces, speed = pair_forces(sensors, len(env.pairs)), np.zeros(len(sensors))
    return {
        "physics": lambda: env._advance(hold),
        "picture": lambda: camera.render(env.data, "front"),
        "sound": lambda: env._sound.step(forces, speed),
        "inverse kinematics": lambda: env._controller.command(np.zeros(4), env.eef_position),
    }


def peer(name: str, folder: Path) -> Helper | None:
    """Another simulator in an environment of its own, which is made where it is missing; None where it does not run."""
    python = folder / "bin" / "python"
    try:
        if not python.exists():
            uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
            subprocess.run([sys.executable, "-m", "venv", folder], check=True)
            installer = [uv, "pip", "install", "--python", str(python)] if uv else [str(python), "-m", "pip", "install"]
            subprocess.run([*map(str, installer), "--quiet", *_PEERS[name]], check=True)
        helper = Helper(str(python), "-c", _ANSWER + _CODE[name])
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
    ours = [Helper(sys.executable, __file__, "--serve", "--task", args.task) for _ in range(2)]
    together(ours, 20)
    others = {name: peer(name, Path("outputs") / name.replace("-", "_")) for name in args.peers.split(",") if name}
    rates: dict[str, list[float]] = {name: [] for name in ("one", "two", *others)}
    for _ in range(args.turns):
        rates["one"].append(together(ours[:1], args.steps))
        rates["two"].append(together(ours, args.steps))
        for name, helper in others.items():
            if helper is not None:
                rates[name].append(helper.measure(str(max(20, args.steps // 10))))
    for helper in [*ours, *others.values()]:
        if helper is not None:
            helper.close()
    middle = medians({name: values for name, values in rates.items() if values})
    parts = medians(in_turns(parts_of_a_step(args.task), 200, warm_up=10))
    needed = 1 / (parts["physics"] + parts["picture"])
    names = [name for name in others if name in middle] or [""]
    one, times = middle["one"], middle["two"] / middle["one"]
    wanted = f"at least {WANTED_RATE}"
    what = "environment, 84 px and 16 kHz, one process"
    rows = [
        Row(
            what,
            one,
            "steps/s",
            _NAMES.get(name, ""),
            middle.get(name),
            "physics and picture alone",
            needed,
            wanted,
            one >= WANTED_RATE,
        )
        for name in names
    ]
    two = f"at least {WANTED_TIMES} times one"
    rows.append(
        Row(
            "environment, two processes",
            middle["two"],
            "steps/s",
            "one process",
            one,
            wanted=two,
            holds=times >= WANTED_TIMES,
        )
    )
    rows += [Row(f"of a step: {name}", 1e3 * seconds, "ms") for name, seconds in parts.items()]
    return rows


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--task", default="OccludedGrasp-v0")
    parser.add_argument("--steps", type=int, default=500, help="of a turn")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--peers", default=",".join(_PEERS), help="which of them to measure beside it")
    parser.add_argument("--serve", action="store_true", help="be a process that steps an environment")
    args = parser.parse_args()
    if args.serve:
        serve_steps(args.task)
        return
    started = machine()
    report("environment", measure(args), args.output, started)


if __name__ == "__main__":
    main()
