"""Talking with the process that simulates: JSON, and bytes for pictures."""

import json
import threading
from multiprocessing.connection import Client, Connection
from typing import Any

import numpy as np


class Link:
    """A connection to the simulation at a socket's path."""

    def __init__(self, path: str) -> None:
        self._connection: Connection = Client(path, "AF_UNIX")
        self._lock = threading.Lock()

    def ask(self, what: str, **more: Any) -> dict[str, Any]:
        """Sends a question and waits for the answer."""
        with self._lock:
            self._connection.send_bytes(json.dumps({"what": what, **more}).encode())
            answer: dict[str, Any] = json.loads(self._connection.recv_bytes())
            if "picture" in answer:
                pixels = np.frombuffer(self._connection.recv_bytes(), np.uint8)
                answer["picture"] = pixels.reshape(answer["picture"])
        if "error" in answer:
            raise ConnectionError(answer["error"])
        return answer

    def close(self) -> None:
        self._connection.close()
