"""How the control loop and the window's process talk: whole objects through pipes, of which only the newest picture counts."""

import pickle
import threading
from typing import IO, Any

import numpy as np

from lerobot_playbyear.teleoperation.status import Status


def send(stream: IO[bytes], message: Any) -> None:
    """Write one message, whatever pickle can hold."""
    pickle.dump(message, stream, pickle.HIGHEST_PROTOCOL)
    stream.flush()


def receive(stream: IO[bytes]) -> Any:
    """Read one message. None: the other side is gone."""
    try:
        return pickle.load(stream)
    except (EOFError, pickle.UnpicklingError):
        return None


class Newest:
    """The newest status and its picture; older ones that nobody took are dropped, and only a newer picture replaces one."""

    def __init__(self) -> None:
        self._newest: tuple[Status, np.ndarray | None] | None = None
        self._changed = threading.Condition()

    def put(self, status: Status, picture: np.ndarray | None) -> None:
        """This is the newest; a picture (H, W, 3) uint8, or None: the last one stays."""
        with self._changed:
            if picture is None and self._newest is not None:
                picture = self._newest[1]
            self._newest = (status, picture)
            self._changed.notify()

    def take(self, timeout_s: float = 0.0) -> tuple[Status, np.ndarray | None] | None:
        """What nobody took yet; None if nothing comes in time."""
        with self._changed:
            if self._newest is None:
                self._changed.wait(timeout_s)
            newest, self._newest = self._newest, None
        return newest
