"""The window, as the control loop sees it: pictures go there, keys come from there.

The window lives in a process of its own. It answers while the policy learns for a minute, its OpenGL does not meet that of
the simulation, and the control loop never waits for it.
"""

import copy
import logging
import os
import subprocess
import sys
import threading

import numpy as np

from lerobot_playbyear.episodes.expert import ExpertError
from lerobot_playbyear.teleoperation.keyboard import WindowKeys
from lerobot_playbyear.teleoperation.status import Status
from lerobot_playbyear.teleoperation.wire import Newest, receive, send

_START_TIMEOUT_S = 60.0
_MODULE = "lerobot_playbyear.teleoperation.window_process"


class Window:
    """Opens a window.

    Args:
        title: Of the window.

    Attributes:
        keys: What a person presses in it.
        is_open: Whether nobody has closed it.

    Raises:
        ExpertError: There is no screen, or something is not installed.
    """

    def __init__(self, title: str) -> None:
        self.keys = WindowKeys()
        self.is_open = False
        self._problem = ""
        self._newest = Newest()
        self._process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, title], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._opened = threading.Event()
        for work in (self._read, self._write):
            threading.Thread(target=work, daemon=True).start()
        if not self._opened.wait(_START_TIMEOUT_S) or not self.is_open:
            self.close()
            raise ExpertError(
                f"No window can be opened (DISPLAY={os.environ.get('DISPLAY', '')!r}): "
                f"{self._problem or 'it did not answer'}. A person as expert needs a screen and OpenGL."
            )

    def show(self, status: Status, picture: np.ndarray | None = None) -> None:
        """Show this as soon as possible, unless something newer comes before; returns at once.

        Args:
            status: What to tell.
            picture: (H, W, 3) uint8; None: the last one stays.
        """
        self._newest.put(copy.deepcopy(status), picture)  # of the status as it is now, because it goes on changing

    def close(self) -> None:
        """Closes it; it may be closed already."""
        self.is_open = False
        self._process.terminate()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._newest.put(Status(), None)  # wakes the thread that writes, and nobody is there to read: it ends

    def _write(self) -> None:
        assert self._process.stdin is not None
        while self._process.poll() is None:
            newest = self._newest.take(timeout_s=1.0)
            if newest is None:
                continue
            try:
                send(self._process.stdin, newest)
            except (OSError, ValueError):
                return

    def _read(self) -> None:
        assert self._process.stdout is not None
        while (message := receive(self._process.stdout)) is not None:
            if "key" in message:
                self.keys.note(message["key"], message["is_pressed"])
            elif "has_focus" in message:
                self.keys.has_focus = message["has_focus"]
            elif "problem" in message:
                self._problem = message["problem"]
            elif message.get("is_open"):
                self.is_open = True
                self._opened.set()
        if self.is_open:
            logging.info("The window was closed.")
        self.is_open = False
        self._opened.set()
