"""What every microphone is, whatever brings its sound."""

import abc
import threading
import time
from collections.abc import Callable

import numpy as np

from lerobot_playbyear.datasets.errors import PlaybyearError

Listener = Callable[[np.ndarray, float], None]
"""Takes a chunk (n, channels), int16 PCM or floats in [-1, 1], and when its last sample came [s of time.perf_counter]."""

_MOST_KEPT_S = 60.0
_FIRST_SOUND_S = 5.0  # how long a card may take until its first chunk; a null sink of PulseAudio takes 2


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


def wait_for_first_sound(microphone: Microphone, listener: Listener, has_come: Callable[[float], bool]) -> None:
    """Waits until something is heard. A card that brings nothing is opened once more: through a sound server a stream that was
    opened now and then never begins.

    Args:
        microphone: Connected with this listener.
        listener: Gets its chunks.
        has_come: Waits for the first one at most for as long [s], and says whether it came.

    Raises:
        MicrophoneError: Nothing comes, or it cannot be opened again.
    """
    if has_come(_FIRST_SOUND_S):
        return
    microphone.disconnect()
    microphone.connect(listener)
    if not has_come(_FIRST_SOUND_S):
        raise MicrophoneError(
            f"From {microphone.name} nothing came in {_FIRST_SOUND_S:.0f} s, and nothing after it was opened again. Is it "
            "plugged in, and used by no other program? `playbyear-find-microphones` shows whether it hears."
        )
