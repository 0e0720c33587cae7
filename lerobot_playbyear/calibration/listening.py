"""What a camera sees and a microphone hears while a person taps."""

import threading
import time
from typing import Any

import numpy as np

from lerobot_playbyear.calibration.estimator import CalibrationError
from lerobot_playbyear.datasets.audio_feature import to_pcm_s16
from lerobot_playbyear.microphones.clock import CardClock

_LEVEL_S = 0.001
_LATE_S = 0.01
_WIDEST = 160  # pixels; a hand is larger
_PICTURE_TIMEOUT_MS = 1000


class SoundLevel:
    """The level of a microphone, millisecond by millisecond. Give `listen` to `Microphone.connect`.

    Args:
        sample_rate: [Hz].
        channel: Which one, counted from 0.
    """

    def __init__(self, sample_rate: int, channel: int) -> None:
        self._rate, self._channel = sample_rate, channel
        self._clock = CardClock(sample_rate, tolerance_s=_LATE_S)
        self._size = max(round(_LEVEL_S * sample_rate), 1)
        self._written, self._last = 0, 0.0
        self._rest: np.ndarray = np.zeros(0)
        self._lock = threading.Lock()
        self._has_come = threading.Event()
        self._times: list[np.ndarray] = []
        self._levels: list[np.ndarray] = []

    def listen(self, chunk: np.ndarray, came_s: float) -> None:
        """Takes a chunk (n, channels), whose last sample came at `came_s` [s of time.perf_counter]."""
        samples = to_pcm_s16(chunk[:, self._channel]).astype(np.float64)
        self._written += len(samples)
        self._written += self._clock.note(self._written, came_s)
        changes = np.abs(np.diff(samples, prepend=self._last))  # of low notes and of a constant little is left
        self._last = samples[-1]
        pending = np.concatenate([self._rest, changes])
        n = len(pending) // self._size
        self._rest = pending[n * self._size :]
        first = self._written - len(pending) + np.arange(n) * self._size  # number of each millisecond's first sample
        starts = came_s + (first - self._clock.written_at(came_s)) / self._rate
        with self._lock:
            self._times.append(starts)
            self._levels.append(pending[: n * self._size].reshape(n, self._size).max(axis=1))
        self._has_come.set()

    def wait_for_sound(self, timeout_s: float) -> bool:
        """Waits for the first chunk: whether it has come in time [s]."""
        return self._has_come.wait(timeout_s)

    def so_far(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) [s of time.perf_counter] and levels (n,), ascending."""
        with self._lock:
            times, levels = np.concatenate([np.zeros(0), *self._times]), np.concatenate([np.zeros(0), *self._levels])
        return np.maximum.accumulate(times) if len(times) else times, levels


class Motion(threading.Thread):
    """How much each picture of a camera differs from the one before, until it is ended.

    Args:
        camera: LeRobot's, connected.
    """

    def __init__(self, camera: Any) -> None:
        super().__init__(name="camera", daemon=True)
        self._camera = camera
        self._ended = threading.Event()
        self._seen: list[tuple[float, float]] = []
        self.problem = ""

    def run(self) -> None:
        before: np.ndarray | None = None
        while not self._ended.is_set():
            try:
                picture = np.asarray(self._camera.async_read(timeout_ms=_PICTURE_TIMEOUT_MS))
            except Exception as error:  # whatever a camera's own program may raise
                self.problem = f"The camera gives no pictures: {error}"
                return
            now = time.perf_counter()
            step = max(picture.shape[1] // _WIDEST, 1)
            small = picture[::step, ::step].astype(np.float32)
            if before is not None and before.shape == small.shape:
                self._seen.append((now, float(np.abs(small - before).mean())))
            before = small

    def so_far(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) [s of time.perf_counter] and motion (n,).

        Raises:
            CalibrationError: No more pictures come.
        """
        if self.problem:
            raise CalibrationError(self.problem)
        seen = np.array(list(self._seen)).reshape(-1, 2)
        return seen[:, 0], seen[:, 1]

    def end(self) -> None:
        """Reads no more pictures."""
        self._ended.set()
        self.join()
