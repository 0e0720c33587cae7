"""The sound of a microphone's session on disk, as it comes: a WAV file that is whole whenever the process ends."""

import logging
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

_FLUSH_S = 0.05
_HEADER_BYTES = 44
_LARGEST = 2**32 - 1
_BLOCK = 65536  # samples


def session_path(folder: Path, session: int, began: str) -> Path:
    """The file of a session in a folder; `began` is a date and time, for people."""
    return folder / f"{began}_{session:08x}.wav"


def find_session(folder: Path, session: int) -> Path | None:
    """A session's file in a folder, if it is there."""
    found = sorted(folder.glob(f"*_{session:08x}.wav")) if folder.is_dir() else []
    return next((path for path in found if path.is_file() and not path.is_symlink()), None)


class SessionFile:
    """Writes what a card hears to a file, in a thread of its own.

    Args:
        path: A new file; its folder is made.
        sample_rate: [Hz].
        written: Says how many samples there are.
        samples: Gives those from one number to before another, (n,) int16.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(
        self, path: Path, sample_rate: int, written: Callable[[], int], samples: Callable[[int, int], np.ndarray]
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._rate, self._written, self._samples = sample_rate, written, samples
        new = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        self._file = os.fdopen(os.open(path, new, 0o600), "wb", buffering=0)
        self._n, self._stop = 0, threading.Event()
        self._write_new()
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
        except OSError as error:
            logging.error(
                "The session's sound is no longer written to %s: %s. Make room and begin again.", self.path, error
            )

    def _write_new(self) -> None:
        end = self._written()
        while True:
            stop = min(end, self._n + _BLOCK)
            self._write(self._samples(self._n, stop).astype("<i2").tobytes(), _HEADER_BYTES + 2 * self._n)
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


class SessionSound:
    """A session's samples from its file, by their numbers.

    Args:
        path: The file.

    Raises:
        ValueError: It is none.
        OSError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
        if len(header) < _HEADER_BYTES or header[:4] != b"RIFF" or header[36:40] != b"data":
            raise ValueError(f"{path} is no file of a microphone's session")
        self.sample_rate = int(struct.unpack_from("<I", header, 24)[0])
        n = (path.stat().st_size - _HEADER_BYTES) // 2
        self._samples = np.memmap(path, "<i2", "r", _HEADER_BYTES, (n,)) if n else np.zeros(0, "<i2")

    def __len__(self) -> int:
        return len(self._samples)

    def samples(self, start: int, stop: int) -> np.ndarray:
        """Samples from one number to before another, (n,) int16; 0 before the first. The last one must be there."""
        before = np.zeros(max(min(-start, stop - start), 0), np.int16)
        return np.concatenate([before, np.asarray(self._samples[max(start, 0) : max(stop, 0)], np.int16)])
