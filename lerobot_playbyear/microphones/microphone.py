"""What every microphone is, whatever brings its sound, and those of other packages."""

import abc
import importlib
import logging
import threading
import time
from collections.abc import Callable
from importlib import metadata
from typing import TYPE_CHECKING

import numpy as np

from lerobot_playbyear.datasets.errors import PlaybyearError

if TYPE_CHECKING:
    from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig

PLUGIN_PREFIX = "lerobot_microphone_"
"""What the name of a distribution begins with that brings sources of sound; its module has the same name."""

Listener = Callable[[np.ndarray, float], None]
"""Takes a chunk (n, channels), int16 PCM or floats in [-1, 1], and when its last sample came [s of time.perf_counter]."""

_MOST_KEPT_S = 60.0


class MicrophoneError(PlaybyearError, RuntimeError):
    """A microphone cannot be opened, or is gone; the message says which, and what to do."""


class Microphone(abc.ABC):
    """A sound card that listens: all of its channels have one clock, and are read together.

    A subclass opens its device in `_open`, calls `_heard` from whatever thread brings samples, and closes it in `_close`.

    Args:
        name: For messages.
        sample_rate: Samples per second [Hz].
        channels: How many.
    """

    def __init__(self, name: str, sample_rate: int, channels: int) -> None:
        self.name, self.sample_rate, self.channels = name, sample_rate, channels
        self._lock = threading.Lock()
        self._chunks: list[np.ndarray] = []
        self._n_kept = 0
        self._listener: Listener | None = None
        self._is_connected = False
        self._last_heard = 0.0
        self._ended = ""

    @property
    def is_connected(self) -> bool:
        """Whether it was connected and not disconnected since."""
        return self._is_connected

    @property
    def problem(self) -> str:
        """Why no more sound comes, if that is certain; empty while all is well."""
        return self._ended

    @property
    def silent_for_s(self) -> float:
        """Since when nothing has come [s]."""
        return time.perf_counter() - self._last_heard

    def connect(self, listener: Listener | None = None) -> None:
        """Begins to listen.

        Args:
            listener: Gets every chunk when it comes, in the device's thread. None: chunks are kept for `read`.

        Raises:
            MicrophoneError: It cannot be opened.
        """
        if self._is_connected:
            return
        self._listener, self._ended, self._chunks, self._n_kept = listener, "", [], 0
        self._last_heard = time.perf_counter()
        self._is_connected = True  # before it may end by itself
        try:
            self._open()
        except BaseException:
            self._is_connected = False
            raise

    def read(self) -> np.ndarray:
        """All samples that have come since the last call, (n, channels), of the last minute at most."""
        with self._lock:
            chunks, self._chunks, self._n_kept = self._chunks, [], 0
        return np.concatenate(chunks) if chunks else np.zeros((0, self.channels), np.int16)

    def disconnect(self) -> None:
        """Stops listening; it may be disconnected already."""
        if self._is_connected:
            self._is_connected = False
            self._close()

    @abc.abstractmethod
    def _open(self) -> None:
        """Opens the device.

        Raises:
            MicrophoneError: It cannot be opened.
        """

    @abc.abstractmethod
    def _close(self) -> None:
        """Closes it."""

    def _heard(self, chunk: np.ndarray, came_s: float) -> None:
        """Samples came, (n, channels); the last of them at `came_s` [s of time.perf_counter]."""
        self._last_heard = time.perf_counter()
        if self._listener is not None:
            self._listener(chunk, came_s)
            return
        with self._lock:
            self._chunks.append(chunk.copy())
            self._n_kept += len(chunk)
            while self._n_kept - len(self._chunks[0]) > _MOST_KEPT_S * self.sample_rate:
                self._n_kept -= len(self._chunks.pop(0))

    def _end(self, reason: str) -> None:
        """No more sound will come."""
        self._ended = self._ended or reason


Source = Callable[["MicrophoneCameraConfig", int], Microphone]
"""Makes a microphone, not connected yet, from a camera's options and how many channels it has at least."""

SOURCES: dict[str, Source] = {}


def register_source(name: str) -> Callable[[Source], Source]:
    """Registers what `--robot.cameras.<name>.source=NAME` makes, from a package named `lerobot_microphone_...`."""

    def register(source: Source) -> Source:
        SOURCES[name] = source
        return source

    return register


def find_source(name: str) -> Source:
    """A registered source.

    Raises:
        MicrophoneError: No installed package registers it.
    """
    if name not in SOURCES:
        for distribution in metadata.distributions():
            module = distribution.metadata.get("Name") or ""
            if module.startswith(PLUGIN_PREFIX):
                try:
                    importlib.import_module(module)
                except Exception:  # whatever is wrong with it, the others work
                    logging.exception("Could not import the microphones of %s", module)
    if name not in SOURCES:
        raise MicrophoneError(
            f"source={name!r} of a microphone is not registered; there is {', '.join(sorted(SOURCES)) or 'none'}. Install its "
            f"package, whose name begins with {PLUGIN_PREFIX}, or give `device`, `file` or `tone_hz` instead."
        )
    return SOURCES[name]
