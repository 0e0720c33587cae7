"""How the control loop and the window's process talk: lines of JSON through pipes, a picture behind the line of a status."""

import json
import math
import threading
from dataclasses import asdict
from typing import IO, Any

import numpy as np

from lerobot_playbyear.teleoperation.status import Control, Status


def send(stream: IO[bytes], message: dict[str, Any] | tuple[Status, np.ndarray | None]) -> None:
    """Write one message: what json can hold, or a status with a picture (H, W, 3) uint8 or None."""
    status, picture = message if isinstance(message, tuple) else (None, None)
    shape = None if picture is None else picture.shape
    line = message if status is None else {"status": asdict(status), "shape": shape}
    stream.write(json.dumps(line).encode() + b"\n")
    if picture is not None:
        stream.write(np.ascontiguousarray(picture).data)
    stream.flush()


def receive(stream: IO[bytes]) -> Any:
    """Read one message. None: the other side is gone."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    message = json.loads(line)
    if "status" not in message:
        return message
    picture, shape = None, message["shape"]
    if shape is not None:
        pixels = stream.read(math.prod(shape))
        if len(pixels) < math.prod(shape):  # cut off
            return None
        picture = np.frombuffer(pixels, np.uint8).reshape(shape)
    values = message["status"]
    values |= {"control": Control(values["control"]), "keys": [(key, meaning) for key, meaning in values["keys"]]}
    return Status(**values), picture


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
