"""A sound file or a tone that plays in real time, as a microphone."""

import threading
import time
from pathlib import Path

import numpy as np

from lerobot_playbyear.audio.audio_files import AudioFileError, read_audio, resample
from lerobot_playbyear.microphones.card import CHUNK_S
from lerobot_playbyear.microphones.microphone import Microphone, MicrophoneError

_TONE_S, _TONE_LEVEL = 1.0, 0.25


class PlayedMicrophone(Microphone):
    """Gives samples again and again, at the speed of time.

    Args:
        name: For messages.
        samples: (n, channels) int16.
        sample_rate: [Hz].
    """

    def __init__(self, name: str, samples: np.ndarray, sample_rate: int) -> None:
        super().__init__(name, sample_rate, samples.shape[1])
        self._samples = samples
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def _open(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._play, name="played sound", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _play(self) -> None:
        size = max(round(CHUNK_S * self.sample_rate), 1)
        n_played, start = 0, time.perf_counter()
        while True:
            due = start + (n_played + size) / self.sample_rate
            if self._stop.wait(max(due - time.perf_counter(), 0)):
                return
            self._heard(self._samples[np.arange(n_played, n_played + size) % len(self._samples)], due)
            n_played += size


def file_microphone(path: Path, sample_rate: int, channels: int) -> Microphone:
    """A sound file, resampled where it has another rate [Hz].

    Raises:
        MicrophoneError: It cannot be read, or has fewer channels.
    """
    try:
        samples, rate = read_audio(path)
    except (OSError, AudioFileError) as error:
        raise MicrophoneError(f"file={path} of a microphone cannot be read: {error}") from error
    if samples.shape[1] < channels or len(samples) == 0:
        raise MicrophoneError(
            f"file={path} of a microphone has {samples.shape[1]} channels and {len(samples)} samples; channel {channels - 1} "
            "is asked for, counted from 0."
        )
    return PlayedMicrophone(f"the sound file {path}", resample(samples, rate, sample_rate), sample_rate)


def tone_microphone(tone_hz: float, sample_rate: int, channels: int) -> Microphone:
    """A sine of a quarter of full scale, the same on all channels; of whole periods in a second where `tone_hz` is whole."""
    time_s = np.arange(round(_TONE_S * sample_rate)) / sample_rate
    wave = np.rint(32767 * _TONE_LEVEL * np.sin(2 * np.pi * tone_hz * time_s)).astype(np.int16)
    return PlayedMicrophone(f"a tone of {tone_hz:g} Hz", np.repeat(wave[:, None], channels, axis=1), sample_rate)
