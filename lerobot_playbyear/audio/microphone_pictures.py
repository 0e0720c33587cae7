"""What a microphone that is recorded as a camera leaves: pictures that carry its sound, and the file of its session.

The **strip**, the lowest rows of a picture, holds the last quarter of a second as bytes and ends with a header. It is exact
wherever pictures are not compressed. The **timecode**, 96 x 64 pixels at the top left, holds the session and the number of
samples so far. It survives video encoders: each bit is a square of 8 pixels whose halves are black and white, in an order that
is the bit. The **session's file** holds all samples since the microphone was connected.
"""

import itertools
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from lerobot_playbyear.audio.audio_files import section
from lerobot_playbyear.audio.sound_picture import PICTURE_PREFIX
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, MICROPHONE
from lerobot_playbyear.datasets.files import HF_LEROBOT_HOME
from lerobot_playbyear.datasets.reader import DatasetReader

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDatasetMetadata

KEPT_S = 0.25
"""Seconds of sound in a strip."""

TIMECODE_WIDTH, TIMECODE_HEIGHT = 96, 64
"""Pixels of the timecode."""

SESSIONS = HF_LEROBOT_HOME / "playbyear_sessions"
"""Where the sound of sessions is written, unless a microphone's `save_to` says otherwise."""

HEADER_BYTES = 44
"""Of a session's file, before its samples."""

_LOOKED_AT = 3  # pictures of a camera that may be a microphone
_CELL = 8  # pixels of a bit, a side
_HEADER = struct.Struct("<4sIQIff")  # magic, session, counter, sample rate, low and high level; a checksum follows
_END_BYTES = _HEADER.size + 4
_MAGIC = b"PBYS"
HIGHEST_RATE = 1_000_000  # Hz


@dataclass(frozen=True)
class Strip:
    """A microphone's newest samples.

    Args:
        session: Of the microphone, from its connection on; above 0.
        counter: How many samples the session had when the last of these came.
        sample_rate: [Hz].
        samples: (kept,) int16, the newest last.
        low_db, high_db: Levels that are black and white in the picture's spectrogram [dB].
    """

    session: int
    counter: int
    sample_rate: int
    samples: np.ndarray
    low_db: float = 0.0
    high_db: float = 0.0


def n_kept(sample_rate: int) -> int:
    """Samples in a strip."""
    return int(KEPT_S * sample_rate)


def n_rows(sample_rate: int, width: int) -> int:
    """Rows of pixels that a strip takes."""
    return -(-(2 * n_kept(sample_rate) + _END_BYTES) // (3 * width))


def write_strip(picture: np.ndarray, strip: Strip) -> None:
    """Draws a strip over the lowest rows of a picture (H, W, 3) uint8, contiguous."""
    rows = picture[-n_rows(strip.sample_rate, picture.shape[1]) :].reshape(-1)
    payload = np.asarray(strip.samples, "<i2").tobytes()
    header = _HEADER.pack(_MAGIC, strip.session, strip.counter, strip.sample_rate, strip.low_db, strip.high_db)
    end = header + _checksum(header, payload)
    rows[:] = np.frombuffer(payload + bytes(len(rows) - len(payload) - len(end)) + end, np.uint8)


def read_strip(picture: np.ndarray) -> Strip | None:
    """The strip of a picture (H, W, 3) uint8, of which the lowest rows are enough; None where there is no whole one."""
    pixels = np.ascontiguousarray(picture, np.uint8)
    if pixels.size < _END_BYTES:
        return None
    end = pixels.reshape(-1)[-_END_BYTES:].tobytes()
    magic, session, counter, sample_rate, low_db, high_db = _HEADER.unpack_from(end)
    if magic != _MAGIC or not 0 < sample_rate <= HIGHEST_RATE:
        return None
    rows = n_rows(sample_rate, pixels.shape[1])
    payload = pixels[-rows:].reshape(-1)[: 2 * n_kept(sample_rate)].copy()
    if rows > len(pixels) or _checksum(end[: _HEADER.size], payload) != end[_HEADER.size :]:
        return None
    return Strip(session, counter, sample_rate, payload.view("<i2").astype(np.int16), low_db, high_db)


def write_timecode(picture: np.ndarray, session: int, counter: int) -> None:
    """Draws the timecode over the top left corner of a picture (H, W, 3) uint8."""
    code = session.to_bytes(4, "little") + counter.to_bytes(5, "little")
    code += _code_checksum(code)
    bits = np.unpackbits(np.frombuffer(code, np.uint8)).reshape(TIMECODE_HEIGHT // _CELL, TIMECODE_WIDTH // _CELL)
    halves = np.stack([1 - bits, bits], axis=-1).reshape(len(bits), -1).astype(np.uint8)  # (8, 24): black is 0
    pixels = (255 * halves).repeat(_CELL, axis=0).repeat(_CELL // 2, axis=1)
    picture[:TIMECODE_HEIGHT, :TIMECODE_WIDTH] = pixels[:, :, None]


def read_timecode(picture: np.ndarray) -> tuple[int, int] | None:
    """Session and counter of a picture (H, W, 3) uint8, also one that was encoded; None where there is no whole timecode."""
    if picture.shape[0] < TIMECODE_HEIGHT or picture.shape[1] < TIMECODE_WIDTH:
        return None
    grey = picture[:TIMECODE_HEIGHT, :TIMECODE_WIDTH].sum(axis=-1, dtype=np.int64)
    halves = grey.reshape(TIMECODE_HEIGHT // _CELL, _CELL, -1, _CELL // 2).sum(axis=(1, 3))  # (8, 24)
    code = np.packbits(halves[:, 1::2] > halves[:, ::2]).tobytes()
    session, counter = int.from_bytes(code[:4], "little"), int.from_bytes(code[4:9], "little")
    if session == 0 or _code_checksum(code[:9]) != code[9:]:
        return None
    return session, counter


def _checksum(header: bytes, payload: bytes | np.ndarray) -> bytes:
    """Four bytes; it was defined over a header that has 0 in their place."""
    return zlib.crc32(payload, zlib.crc32(header + bytes(4))).to_bytes(4, "little")


def _code_checksum(code: bytes) -> bytes:
    return zlib.crc32(code).to_bytes(4, "little")[:3]


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
            raise ValueError(f"{path} is not a microphone's session file")
        form, channels, self.sample_rate = struct.unpack_from("<HHI", header, 20)
        if (form, channels, header[34]) != (1, 1, 16) or not 0 < self.sample_rate <= HIGHEST_RATE:
            raise ValueError(f"{path} is not a microphone's session file: wanted one channel of 16 bits")
        n = (path.stat().st_size - HEADER_BYTES) // 2
        self._samples = np.memmap(path, "<i2", "r", HEADER_BYTES, (n,)) if n else np.zeros(0, "<i2")

    def __len__(self) -> int:
        return len(self._samples)

    def samples(self, start: int, stop: int) -> np.ndarray:
        """Samples from one number to before another, (n,) int16; 0 where there are none."""
        return section(self._samples, start, stop).astype(np.int16)


def audio_key_of(picture: str) -> str:
    """The sound of a microphone whose pictures are `observation.images.<mic>`."""
    return AUDIO_PREFIX + picture.removeprefix(PICTURE_PREFIX)


def microphone_pictures(meta: "LeRobotDatasetMetadata") -> list[str]:
    """The features of a dataset that are a microphone's pictures; those whose files are not here are not looked at."""
    return [
        key
        for key, feature in meta.features.items()
        if feature["dtype"] in ("image", "video")
        and tuple(feature["shape"])[-1] == 3
        and (MICROPHONE in (feature.get("info") or {}) or any(map(read_timecode, _first_pictures(meta, key))))
    ]


def _first_pictures(meta: "LeRobotDatasetMetadata", key: str) -> Iterator[np.ndarray]:
    """The first episode's first pictures, (H, W, C) uint8; none where they cannot be read, which others say better."""
    try:
        reader = DatasetReader(meta.repo_id, meta=meta)
        yield from itertools.islice(reader.pictures(key, reader.episodes[0]), _LOOKED_AT)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, Image.DecompressionBombError):
        return
