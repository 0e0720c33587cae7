"""How the control loop and the window's process talk: messages of JSON, and of a picture after it."""

import json
import struct
from typing import IO, Any

import numpy as np

_LENGTHS = struct.Struct(">II")


def send(stream: IO[bytes], message: dict[str, Any], picture: np.ndarray | None = None) -> None:
    """Write one message.

    Args:
        stream: A pipe.
        message: What json can hold.
        picture: (H, W, 3) uint8.
    """
    if picture is not None:
        message = {**message, "picture": picture.shape}
    text = json.dumps(message).encode()
    pixels = b"" if picture is None else np.ascontiguousarray(picture, np.uint8).tobytes()
    stream.write(_LENGTHS.pack(len(text), len(pixels)) + text)
    stream.write(pixels)
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[dict[str, Any], np.ndarray | None] | None:
    """Read one message and its picture. None: the other side is gone."""
    head = stream.read(_LENGTHS.size)
    if len(head) < _LENGTHS.size:
        return None
    n_text, n_pixels = _LENGTHS.unpack(head)
    text, pixels = stream.read(n_text), stream.read(n_pixels)
    if len(text) < n_text or len(pixels) < n_pixels:
        return None
    message = json.loads(text)
    shape = message.pop("picture", None)
    return message, None if shape is None else np.frombuffer(pixels, np.uint8).reshape(shape)
