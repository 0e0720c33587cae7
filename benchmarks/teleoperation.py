"""What a person's window costs, against the 50 ms of a control step; needs a screen (`DISPLAY`).

    xvfb-run python benchmarks/teleoperation.py        # on a machine without one

Draws 200 frames of a real task: rendering the scene for people (480 x 480), handing it to the window's process, and, in that
process, drawing the panel and showing both. Medians of wall time, and processor time per frame.
"""

import argparse
import os
import time
from collections.abc import Callable

from common import in_turns, medians

os.environ.setdefault("MUJOCO_GL", "egl")


def measured(work: Callable[[], object], n: int) -> tuple[float, float]:
    """Median wall time and mean processor time [ms] of a piece of work."""
    work()
    before = time.process_time()
    wall = medians(in_turns({"work": work}, n, warm_up=0))["work"]
    return 1e3 * wall, 1e3 * (time.process_time() - before) / n


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_frames", type=int, default=200)
    args = parser.parse_args()
    if not os.environ.get("DISPLAY") and os.name == "posix" and not os.environ.get("WAYLAND_DISPLAY"):
        print("No screen: nothing measured. Try: xvfb-run python benchmarks/teleoperation.py")
        return
    import glfw
    import gymnasium as gym
    import numpy as np
    from OpenGL import GL

    import gym_playbyear  # noqa: F401
    from lerobot_playbyear.teleoperation.panel import Control, Status, draw
    from lerobot_playbyear.teleoperation.window import Screen, Window

    keys = [("Space", "hold to take over")] * 9
    levels = {"gripper": [-60.0, -20.0] * 40}
    status = Status(Control.PERSON, "Find the cube " * 6, 3, 40, 102, 20.0, 20.0, "open", 0.5, levels, "", keys)
    scene = np.random.default_rng(0).integers(0, 256, (480, 480, 3), np.uint8)
    screen, picture = Screen(glfw, GL, "Benchmark"), draw(status)

    def show() -> None:
        glfw.poll_events()
        screen.show(picture, scene)

    rows = {"window's process: draw the panel": measured(lambda: draw(status), args.n_frames)}
    rows["window's process: show both"] = measured(show, args.n_frames)
    glfw.terminate()  # this OpenGL and the simulation's cannot be in one process at the same time
    window = Window("Benchmark")
    rows["hand a frame to the window"] = measured(lambda: window.show(status, scene), args.n_frames)
    window.close()
    env = gym.make("gym_playbyear/OccludedGrasp-v1", render_mode="rgb_array")
    env.reset(seed=0)
    rows["render the scene, 480 x 480"] = measured(env.render, args.n_frames)
    env.close()
    for name, (wall, processor) in rows.items():
        print(f"{name:36s} {wall:6.1f} ms, {processor:6.1f} ms of processor time")


if __name__ == "__main__":
    main()
