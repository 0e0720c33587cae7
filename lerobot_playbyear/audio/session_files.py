"""The files in which microphones leave the sound of their sessions: where they are, and what is in them."""

import struct
from pathlib import Path

import numpy as np

from lerobot_playbyear.audio.sample_strip import HIGHEST_RATE
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME

SESSIONS = HF_LEROBOT_HOME / "playbyear_sessions"
"""Where the sound of sessions is written, unless a microphone's `save_to` says otherwise."""

HEADER_BYTES = 44


def session_path(folder: Path, session: int, began: str) -> Path:
    """The file of a session in a folder; `began` is a date and time, for people."""
    return folder / f"{began}_{session:08x}.wav"


def find_session(folder: Path, session: int) -> Path | None:
    """A session's file in a folder, if it is there."""
    found = sorted(folder.glob(f"*_{session:08x}.wav")) if folder.is_dir() else []
    return next((path for path in found if path.is_file() and not path.is_symlink()), None)


class SessionSound:
    """A session's samples from its file, by their numbers.

    Args:
        path: The file.

    Raises:
        ValueError: It is none.
        OSError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as file:
            header = file.read(HEADER_BYTES)
        if len(header) < HEADER_BYTES or header[:4] != b"RIFF" or header[36:40] != b"data":
            raise ValueError(f"{path} is no file of a microphone's session")
        form, channels, self.sample_rate = struct.unpack_from("<HHI", header, 20)
        if (form, channels, header[34]) != (1, 1, 16) or not 0 < self.sample_rate <= HIGHEST_RATE:
            raise ValueError(f"{path} is no file of a microphone's session: wanted one channel of 16 bits")
        n = (path.stat().st_size - HEADER_BYTES) // 2
        self._samples = np.memmap(path, "<i2", "r", HEADER_BYTES, (n,)) if n else np.zeros(0, "<i2")

    def __len__(self) -> int:
        return len(self._samples)

    def samples(self, start: int, stop: int) -> np.ndarray:
        """Samples from one number to before another, (n,) int16; 0 before the first. The last one must be there."""
        before = np.zeros(max(min(-start, stop - start), 0), np.int16)
        return np.concatenate([before, np.asarray(self._samples[max(start, 0) : max(stop, 0)], np.int16)])
