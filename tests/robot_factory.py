"""The simulated robots of `sim_robot` for tests, and sound for microphones that play files."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lerobot_playbyear.datasets.audio_feature import write_wav

SIM_ROBOT = Path(__file__).parent / "sim_robot"
"""What has to be on PYTHONPATH for LeRobot's discovery to find the robots that are not there."""

if str(SIM_ROBOT) not in sys.path:
    sys.path.insert(0, str(SIM_ROBOT))


def with_sim_robot(environment: dict[str, str] | None = None) -> dict[str, str]:
    """An environment of a command that knows these robots."""
    environment = dict(os.environ if environment is None else environment)
    ours = [str(SIM_ROBOT), str(SIM_ROBOT.parent)]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [*ours, environment.get("PYTHONPATH", "")]))
    return environment


@contextmanager
def simulation(folder: Path, fifo: Path | str = "", *options: str) -> Iterator[str]:
    """The task's arm in a process of its own, in real time; the path of its socket.

    Args:
        folder: For the socket; its path is short.
        fifo: Where its sound goes.
        options: Of `lerobot_robot_playbyear_sim.simulation`.
    """
    socket = str(folder / "arm")
    module = "lerobot_robot_playbyear_sim.simulation"
    command = [sys.executable, "-m", module, f"--socket={socket}", f"--fifo={fifo}", *options]
    environment = with_sim_robot({**os.environ, "OMP_NUM_THREADS": "1"})
    # It ends with its standard input, so also when this process is killed.
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    process = subprocess.Popen(command, env=environment, text=True, **pipes)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready"
        yield socket
    finally:
        process.kill()
        process.wait()


def noise_file(folder: Path, sample_rate: int, seconds: float = 5.0, channels: int = 1) -> Path:
    """A WAV file in which every place is unlike any other."""
    rng = np.random.default_rng(0)
    samples = rng.normal(0, 3000, (round(seconds * sample_rate), channels)).astype(np.int16)
    return write_wav(folder / "noise.wav", samples, sample_rate)


def wait_until(is_so: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Returns when something is so."""
    deadline = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < deadline, "it never came to be"
        time.sleep(0.01)
