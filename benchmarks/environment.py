"""Environment steps per second, picture and sound included, beside robosuite's for the same arm, camera and control rate.

    python benchmarks/environment.py --robosuite=true

robosuite needs another MuJoCo than ours: with `--robosuite=true` it is installed into an environment of its own
(`outputs/robosuite`) and run there, in turn with ours. Random actions; the median of the repetitions.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
_ROBOSUITE = ("robosuite==1.5.2", "mujoco==3.3.7", "numpy<2.3")
_ROBOSUITE_CODE = """
import json, sys, time, logging
logging.disable(logging.CRITICAL)
import numpy as np, robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=True, use_camera_obs=True,
    camera_names="agentview", camera_heights=84, camera_widths=84, control_freq=20, horizon=100000)
env.reset()
rng = np.random.default_rng(0)
n_steps = int(sys.argv[1])
actions = rng.uniform(-0.2, 0.2, (n_steps + 20, env.action_dim))
for action in actions[:20]:
    env.step(action)
start = time.perf_counter()
for action in actions[20:]:
    env.step(action)
print("rate", n_steps / (time.perf_counter() - start))
"""


def our_rate(task: str, n_steps: int) -> float:
    """Steps per second of one environment in this process [1/s], with its resets."""
    import gymnasium as gym
    import numpy as np

    import gym_playbyear  # noqa: F401

    env = gym.make(f"gym_playbyear/{task}")
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (n_steps + 20, 4)).astype(np.float32)
    for action in actions[:20]:
        env.step(action)
    start = time.perf_counter()
    for action in actions[20:]:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    rate = n_steps / (time.perf_counter() - start)
    env.close()
    return rate


def robosuite_python(folder: Path) -> Path:
    """The interpreter of robosuite's own environment, which is made where it is missing."""
    python = folder / "bin" / "python"
    if not python.exists():
        uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        installer = [uv, "pip", "install", "--python", python] if uv else [python, "-m", "pip", "install"]
        subprocess.run([*map(str, installer), "--quiet", *_ROBOSUITE], check=True)
    return python


def robosuite_rate(python: Path, n_steps: int) -> float:
    """Steps per second of robosuite's Lift task in a process of its own [1/s]."""
    result = subprocess.run(
        [str(python), "-c", _ROBOSUITE_CODE, str(n_steps)], capture_output=True, text=True, check=False
    )
    if result.returncode != 0:
        raise RuntimeError(f"robosuite did not run:\n{result.stderr[-2000:]}")
    return float(result.stdout.split("rate")[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="OccludedGrasp-v0")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--robosuite", default="false", choices=("true", "false"))
    parser.add_argument("--output", type=Path, default=Path("outputs/bench_environment.json"))
    args = parser.parse_args()

    python = robosuite_python(Path("outputs/robosuite")) if args.robosuite == "true" else None
    ours, theirs = [], []
    for _ in range(args.repetitions):
        ours.append(our_rate(args.task, args.steps))
        if python is not None:
            theirs.append(robosuite_rate(python, max(100, args.steps // 4)))
    figures: dict[str, float] = {"steps_per_second": statistics.median(ours)}
    if theirs:
        figures["robosuite_steps_per_second"] = statistics.median(theirs)
        figures["ratio"] = figures["steps_per_second"] / figures["robosuite_steps_per_second"]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps(figures, indent=1) + "\n")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
