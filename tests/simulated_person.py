"""A person at a terminal, who sees the simulated arm and presses keys."""

import os
import pty
import re
import select
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence

from lerobot_robot_playbyear_sim.link import Link


class SimulatedPerson:
    """Begins every attempt, ends it as it went, throws it away where the robot stopped, and takes over where the script would.

    Args:
        socket: Of the simulated arm.
        most_steps: After which an attempt is given up.
        corrects: Whether they take over, and hand back, with the space bar.
    """

    def __init__(self, socket: str, most_steps: int = 400, corrects: bool = False) -> None:
        self._link = Link(socket)
        self._most_steps, self._corrects = most_steps, corrects
        self.output = ""
        self.pressed: list[str] = []
        self._acts, self._n_begun, self._n_troubles = False, 0, 0
        self._judged = -1
        self.tapped = 0.0

    def run(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        timeout_s: float = 300,
        kill_when: Callable[["SimulatedPerson"], bool] = lambda person: False,
        at_times: Callable[["SimulatedPerson"], None] = lambda person: None,
    ) -> int:
        """Runs a command in a terminal of its own and sits before it. Returns its exit status, -9 if it was killed."""
        self.output = ""
        self._n_begun = self._judged = self._n_troubles = 0
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            command, stdin=theirs, stdout=theirs, stderr=theirs, env=dict(environment), start_new_session=True
        )
        os.close(theirs)
        reader = threading.Thread(target=self._read, args=(ours,), daemon=True)
        reader.start()
        deadline = time.monotonic() + timeout_s
        try:
            while process.poll() is None:
                assert time.monotonic() < deadline, self.output[-4000:]
                if kill_when(self):
                    os.killpg(process.pid, signal.SIGKILL)
                    break
                at_times(self)
                key = self._wish()
                if key:
                    self.pressed.append(key)
                    os.write(ours, key.encode())
                time.sleep(0.02)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            reader.join(timeout=2)
        return process.returncode

    def _wish(self) -> str:
        n_asked = len(re.findall("press P to begin", self.output))
        if n_asked > self._n_begun:
            self._n_begun, self._acts = n_asked, False
            return "p"
        n_troubles = self.output.count("throws the attempt away")
        if n_troubles > self._n_troubles:
            self._n_troubles, self._judged = n_troubles, self._n_begun
            return "r"
        if self._judged >= self._n_begun:
            return ""
        now = self._link.ask("status")
        if now["n_steps"] == 0:
            return ""
        if now["success"] or now["failed"] or now["n_steps"] > self._most_steps:
            self._judged = self._n_begun
            return "s" if now["success"] else "q"
        if self._corrects and now["wants_control"] != self._acts:
            self._acts = not self._acts
            return " "
        return ""

    def _read(self, terminal: int) -> None:
        while True:
            ready, _, _ = select.select([terminal], [], [], 1)
            try:
                text = os.read(terminal, 4096) if ready else b" "
            except OSError:  # the other end is closed
                os.close(terminal)
                return
            if ready:
                self.output += text.decode(errors="replace")

    def close(self) -> None:
        self._link.close()
