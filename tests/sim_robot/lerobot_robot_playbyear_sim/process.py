"""Starting the simulation, and commands that know its devices."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FOLDER = Path(__file__).parents[1]
"""What has to be on PYTHONPATH for LeRobot's discovery to find the devices that are not there."""


def with_sim_robot(environment: dict[str, str] | None = None) -> dict[str, str]:
    """An environment of a command that knows these devices."""
    environment = dict(os.environ if environment is None else environment)
    ours = [str(FOLDER), str(FOLDER.parent)]
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
