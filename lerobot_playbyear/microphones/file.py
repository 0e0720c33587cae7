"""A sound file that plays in real time, as a microphone."""

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_playbyear.datasets.audio_files import AudioFileError, read_audio
from lerobot_playbyear.microphones.microphone import Microphone, MicrophoneError

if TYPE_CHECKING:
    from lerobot_playbyear.microphones.config import FileMicrophoneConfig

_CHUNK_S = 0.005


class FileMicrophone(Microphone):
    """Gives a file's samples at the speed at which they were recorded.

    Args:
        config: Its options.
        channels: How many.
    """

    def __init__(self, config: "FileMicrophoneConfig", channels: int) -> None:
        super().__init__(f"the sound file {config.path}", config.sample_rate, channels)
        self._config = config
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def _open(self) -> None:
        self._samples = self._read()
        self._stop.clear()
        self._thread = threading.Thread(target=self._play, name="sound file", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _read(self) -> np.ndarray:
        path = Path(self._config.path)
        try:
            samples, rate = read_audio(path)
        except (OSError, AudioFileError) as error:
            raise MicrophoneError(f"path={path} of a microphone cannot be read: {error}") from error
        if rate != self.sample_rate:
            raise MicrophoneError(
                f"path={path} of a microphone has {rate} Hz, and sample_rate={self.sample_rate} is asked for: give {rate}."
            )
        if samples.shape[1] < self.channels or len(samples) == 0:
            raise MicrophoneError(
                f"path={path} of a microphone has {samples.shape[1]} channels and {len(samples)} samples; channel "
                f"{self.channels - 1} is asked for, counted from 0."
            )
        return samples[:, : self.channels]

    def _play(self) -> None:
        size = max(round(_CHUNK_S * self.sample_rate), 1)
        n_played, start = 0, time.perf_counter()
        while True:
            due = start + (n_played + size) / (self.sample_rate * self._config.speed)
            if self._stop.wait(max(due - time.perf_counter(), 0)):
                return
            places = np.arange(n_played, n_played + size)
            if not self._config.repeat and places[-1] >= len(self._samples):
                self._end("the sound file is at its end")
                return
            self._heard(self._samples[places % len(self._samples)], due)
            n_played += size
