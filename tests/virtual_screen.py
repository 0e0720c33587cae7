"""A screen without a monitor, on which real windows get real key events."""

import itertools
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import ImageGrab

_numbers = itertools.count()
MISSING = [name for name in ("Xvfb", "xdotool") if shutil.which(name) is None]
"""What is not installed (Debian: xvfb, xdotool)."""

needs_screen = pytest.mark.skipif(
    bool(MISSING), reason=f"{' and '.join(MISSING)} not installed (Debian: apt-get install xvfb xdotool)"
)


class VirtualScreen:
    """An X server of its own.

    Attributes:
        display: Its name, for `DISPLAY`.
    """

    def __init__(self, width: int = 1100, height: int = 800) -> None:
        # Two that look for a free number at the same time take the same, so each process has a hundred of its own.
        number = 100 + os.getpid() % 500 * 100 + next(_numbers)
        read, write = os.pipe()
        size = f"{width}x{height}x24"
        command = ["Xvfb", f":{number}", "-displayfd", str(write), "-screen", "0", size, "-nolisten", "tcp"]
        command += ["-noreset"]  # otherwise it starts again when its last client leaves, and turns away who comes then
        self._process = subprocess.Popen(
            command, pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(write)
        with os.fdopen(read) as answer:
            assert answer.readline().strip() == str(number), "Xvfb did not start"
        self.display = f":{number}"

    @property
    def environment(self) -> dict[str, str]:
        """For a process that uses this screen."""
        kept = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
        return {**kept, "DISPLAY": self.display, "XDG_SESSION_TYPE": "x11"}

    def press(self, *names: str) -> None:
        """Keys go down and up again, one after another, by their X names."""
        self._xdotool("key", *names)

    def hold(self, *names: str) -> None:
        """Keys go down."""
        self._xdotool("keydown", *names)

    def let_go(self, *names: str) -> None:
        """Keys go up."""
        self._xdotool("keyup", *names)

    def window(self, title: str, timeout_s: float = 60.0) -> str:
        """Waits for a window whose title contains this; returns its number."""

        def find() -> str:
            command = ["xdotool", "search", "--onlyvisible", "--name", title]
            return subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False).stdout

        return wait_for(find, timeout_s).split()[0]

    def kill_window(self, number: str) -> None:
        """Takes a window away from its process."""
        self._xdotool("windowkill", number)

    def focus(self, number: str) -> None:
        """Gives a window the keyboard."""
        self._xdotool("windowfocus", "--sync", number)

    def picture(self) -> np.ndarray:
        """What is on the screen, (height, width, 3) uint8."""
        return np.asarray(ImageGrab.grab(xdisplay=self.display).convert("RGB"))

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=20)

    def _xdotool(self, *args: str) -> None:
        subprocess.run(["xdotool", *args], env=self.environment, check=True, timeout=60)


def wait_for(question: Callable[[], Any], timeout_s: float = 60.0) -> Any:
    """Asks until the answer is true, and returns it."""
    deadline = time.monotonic() + timeout_s
    while not (answer := question()):
        assert time.monotonic() < deadline, f"still {answer!r} after {timeout_s} s"
        time.sleep(0.01)
    return answer
