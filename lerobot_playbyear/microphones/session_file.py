"""The sound of a microphone's session on disk, as it comes: a WAV file that is whole whenever the process ends."""

import logging
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lerobot_playbyear.audio.microphone_pictures import HEADER_BYTES

_FLUSH_S = 0.05
_LARGEST = 2**32 - 1
_BLOCK = 65536  # samples


class SessionFile:
    """Writes what a card hears to a file, in a thread of its own.

    Args:
        path: A new file; its folder is made.
        rate: Samples per second [Hz].
        written: Says how many samples there are.
        samples: Gives those from one number to before another, (n,) int16.
        n_kept: How many of the newest ones it gives.

    Attributes:
        error: Why no more is written; empty while all is well.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(
        self, path: Path, rate: int, written: Callable[[], int], samples: Callable[[int, int], np.ndarray], n_kept: int
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.error = path, ""
        self._rate, self._written, self._samples = rate, written, samples
        new = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        self._file = os.fdopen(os.open(path, new, 0o600), "wb", buffering=0)
        self._n_kept = n_kept
        self._n = max(written() - n_kept + rate // 10, 0)  # what is older is a hole in the file, and silence
        self._stop = threading.Event()
        try:
            self._write_new()
        except BaseException:
            self._file.close()
            path.unlink()
            raise
        self._thread = threading.Thread(target=self._run, name=f"session {path.name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Writes what is left, and ends."""
        self._stop.set()
        self._thread.join()
        self._file.close()

    def _run(self) -> None:
        try:
            while not self._stop.wait(_FLUSH_S):
                self._write_new()
            self._write_new()
        except Exception as error:  # whatever it is, the sound is not saved
            self.error = f"the session's sound is no longer written to {self.path}: {error}"
            logging.error("From %.1f s on %s.", self._n / self._rate, self.error)

    def _write_new(self) -> None:
        end = self._written()
        while True:
            stop = min(end, self._n + _BLOCK)
            samples = self._samples(self._n, stop)
            if self._written() - self._n > self._n_kept:  # now: they may have gone while they were read
                raise OSError("the disk was too slow, and sound is lost")
            self._write(samples.astype("<i2").tobytes(), HEADER_BYTES + 2 * self._n)
            self._n = stop
            if stop == end:
                break
        size = 2 * self._n
        form = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 1, self._rate, 2 * self._rate, 2, 16)
        header = struct.pack("<4sI4s", b"RIFF", min(size + 36, _LARGEST), b"WAVE") + form
        self._write(header + struct.pack("<4sI", b"data", min(size, _LARGEST)), 0)

    def _write(self, data: bytes, place: int) -> None:
        self._file.seek(place)
        while data:
            data = data[self._file.write(data) :]
