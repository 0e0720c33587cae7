"""What a microphone hears: how loud it is, and playing it, if the package `sounddevice` is there."""

import contextlib
import sys
import threading
from typing import Any

import numpy as np

from lerobot_playbyear.episodes.play import Observation

FLOOR_DB = -80.0
_AUDIO = "audio."  # how raw observations name microphones
_FULL_SCALE = 32768.0

_LATENCY_BLOCKS = 2  # that are there before the first is played, so that a late step leaves no gap
_BELL_HZ, _BELL_S, _BELL_LEVEL = 880.0, 0.2, 0.3
_MOST_BLOCKS = 6  # more than this is too late to be played


def microphone_blocks(observation: Observation) -> dict[str, np.ndarray]:
    """The samples (S,) of each microphone in a raw observation, int16 there, as floats of full scale 1, by its name."""
    blocks = {key.removeprefix(_AUDIO): value for key, value in observation.items() if key.startswith(_AUDIO)}
    return {name: np.asarray(block, np.float32) / _FULL_SCALE for name, block in blocks.items()}


def level_db(block: np.ndarray) -> float:
    """Root mean square of samples in [-1, 1] [dB of full scale], at least `FLOOR_DB`."""
    power = float(np.mean(np.square(block, dtype=np.float64))) if block.size else 0.0
    return max(10 * np.log10(power), FLOOR_DB) if power > 0 else FLOOR_DB


class Speaker:
    """The default output of the sound card: the control loop brings a block per step, and it takes what it likes.

    Args:
        sample_rate: [Hz].
        block_size: Samples per step.
        problem: Why it stays silent, if so.

    Attributes:
        problem: Why nothing is heard; empty if it is.
    """

    def __init__(self, sample_rate: int, block_size: int, problem: str = "") -> None:
        self._block_size, self._sample_rate = block_size, sample_rate
        self._samples: np.ndarray = np.zeros(0, np.float32)
        self._bell: np.ndarray = np.zeros(0, np.float32)
        self._is_playing = False
        self._lock = threading.Lock()
        self._stream: Any = None
        self.problem = problem
        if problem:
            return
        try:
            import sounddevice  # type: ignore[import-not-found, import-untyped, unused-ignore]

            self._stream = sounddevice.OutputStream(sample_rate, channels=1, dtype="float32", callback=self._fill)
            self._stream.start()
        except ImportError:
            self.problem = "pip install sounddevice"
        except OSError:
            self.problem = "PortAudio is missing (Debian: libportaudio2)"
        except Exception as error:  # whatever a sound card may say, work goes on without
            self.problem = f"no sound card ({str(error).splitlines()[0]})"
            self.close()

    def play(self, block: np.ndarray) -> None:
        """What was heard in a step, (S,) in [-1, 1]."""
        with self._lock:
            self._samples = np.concatenate([self._samples, block])[-_MOST_BLOCKS * self._block_size :]
            self._is_playing |= len(self._samples) >= _LATENCY_BLOCKS * self._block_size

    def ring(self) -> None:
        """Rings for a person, above all that is heard; where nothing is played, by the terminal's bell."""
        if self._stream is None:
            sys.stderr.write("\a")
            sys.stderr.flush()
            return
        t = np.arange(round(_BELL_S * self._sample_rate)) / self._sample_rate
        with self._lock:
            fading = np.linspace(1, 0, len(t))
            self._bell = (_BELL_LEVEL * fading * np.sin(2 * np.pi * _BELL_HZ * t)).astype(np.float32)

    def take(self, n: int) -> np.ndarray:
        """The next n samples, which are then played; silence where there are none."""
        played = np.zeros(n, np.float32)
        with self._lock:
            if self._is_playing:
                head, self._samples = self._samples[:n], self._samples[n:]
                played[: len(head)] = head
                self._is_playing = len(head) == n
            bell, self._bell = self._bell[:n], self._bell[n:]
            played[: len(bell)] += bell
        return played

    def clear(self) -> None:
        """What has not been played yet is not played any more."""
        with self._lock:
            self._samples, self._is_playing = self._samples[:0], False

    def close(self) -> None:
        if self._stream is not None:
            with contextlib.suppress(Exception):
                self._stream.close()
            self._stream = None

    def _fill(self, out: np.ndarray, n_frames: int, time: Any, status: Any) -> None:
        out[:, 0] = self.take(n_frames)
