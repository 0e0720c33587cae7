"""Worker processes end when they are told to, whatever they are doing, and leave nobody waiting."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest

BIG = 4_000_000  # bytes of an observation: an episode takes a good part of a second to send


class BigEnv(gym.Env):
    """Episodes that are short and large."""

    metadata: ClassVar = {"render_fps": 20}
    observation_space = gym.spaces.Dict({"agent_pos": gym.spaces.Box(0, 1, (BIG // 4,), np.float32)})
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def scripted_expert(self):
        return self

    def act(self):
        return np.zeros(1, np.float32)

    def reset(self, *, seed=None, options=None):
        self._n_steps = 0
        return {"agent_pos": np.zeros(BIG // 4, np.float32)}, {}

    def step(self, action):
        self._n_steps += 1
        return {"agent_pos": np.zeros(BIG // 4, np.float32)}, 0.0, self._n_steps == 20, False, {"is_success": True}


gym.register("Big-v0", entry_point=BigEnv)

TAKE_ONE = """
import multiprocessing, os, signal, sys, time
sys.path.insert(0, {tests!r})
from contextlib import closing
from lerobot_playbyear.episodes.environment import EnvSpec
from lerobot_playbyear.episodes.pool import RolloutPool
if __name__ == "__main__":
    with closing(RolloutPool(EnvSpec("test_rollout_pool:Big-v0"), num_workers=1)) as pool:
        next(pool.episodes(range(100)))
        {then}
    print("closed")
"""


def take_one(folder: Path, then: str) -> subprocess.CompletedProcess:
    """What becomes of a program, which is a process of its own, that takes an episode and then does something."""
    script = folder / "take_one.py"
    script.write_text(TAKE_ONE.format(tests=str(Path(__file__).parent), then=then))
    return subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=40)


@pytest.mark.slow
@pytest.mark.parametrize("wait", [pytest.param(0.0, marks=pytest.mark.slow), 0.06])
def test_a_worker_that_is_sending_an_episode_does_not_keep_the_program_from_ending(tmp_path, wait):
    done = take_one(tmp_path, f"time.sleep({wait})")
    assert (done.stdout, done.returncode) == ("closed\n", 0), done.stderr


def test_workers_do_not_outlive_a_parent_that_was_killed(tmp_path):
    tell = "print(*[child.pid for child in multiprocessing.active_children()], flush=True)"
    done = take_one(tmp_path, f"{tell}, os.kill(os.getpid(), signal.SIGKILL)")
    workers = [int(number) for number in done.stdout.split()]
    assert workers
    deadline = time.monotonic() + 20
    while any(_is_alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_is_alive(pid) for pid in workers)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"
