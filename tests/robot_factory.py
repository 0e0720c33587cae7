"""A robot's environment for tests: the arm of joints, or the simulated one, with whatever microphones."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.audio_feature import write_wav
from lerobot_playbyear.teleoperation.keyboard import WindowKeys
from lerobot_playbyear.teleoperation.status import Status

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


class ScriptedConsole:
    """A person who does what a test says.

    Args:
        on_show: Gets every status; what it returns is pressed.
    """

    has_key_releases = False

    def __init__(self, on_show: Callable[[Status], str | None] = lambda status: None) -> None:
        self.keys, self.is_open = WindowKeys(), True
        self.on_show = on_show
        self.notes: list[str] = []

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        if status.note and status.note not in self.notes[-1:]:
            self.notes.append(status.note)
        self.press(self.on_show(status))

    def press(self, key: str | None) -> None:
        if key:
            self.keys.note(key, True)
            self.keys.note(key, False)

    def close(self) -> None:
        self.is_open = False


def joint_config(wav: Path | None = None, **changes: Any):
    """The options of the arm of joints, with one microphone that plays a file."""
    from lerobot_robot_playbyear_sim import JointArmConfig

    from lerobot_playbyear.microphones.config import FileMicrophoneConfig
    from lerobot_playbyear.robots.config import RobotEnvConfig

    microphones = {} if wav is None else {"gripper": FileMicrophoneConfig(path=str(wav), sample_rate=16000)}
    options: dict[str, Any] = {
        "fps": 20,
        "robot": JointArmConfig(),
        "microphones": microphones,
        "episode_s": 1.0,
        "rest_s": 0.1,
        "console": "none",
        "task": "Reach out",
    }
    return RobotEnvConfig(**options | changes)


@contextmanager
def robot_env(config: Any, console: Any = None) -> Iterator[Any]:
    """The environment itself, closed at the end."""
    from lerobot_playbyear.robots.env import RobotEnv

    env = RobotEnv(config)
    if console is not None:
        env._rig.console = console
    try:
        yield env
    finally:
        env.close()


def wait_until(is_so: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Returns when something is so."""
    deadline = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < deadline, "it never came to be"
        time.sleep(0.01)
