"""A checksum at the end of an mp4 file: videos have none of their own, and a flipped bit in one is hardly seen.

It sits in a box of a type that programs skip when they do not know it (`uuid`), so that the film plays everywhere.
Tools that cut or join films leave it out.
"""

import hashlib
import os
import struct
import uuid
from pathlib import Path

_OURS = uuid.uuid5(uuid.NAMESPACE_URL, "lerobot-playbyear/sha256").bytes
_HEAD = struct.pack(">I4s16s", 8 + 16 + 32, b"uuid", _OURS)  # length of the box, type, whose it is
_SIZE = len(_HEAD) + hashlib.sha256().digest_size


def seal(path: Path) -> None:
    """Appends the checksum to a finished mp4 file, or leaves it as it was where the disk does not take it."""
    size = path.stat().st_size
    digest = _digest(path, size)
    try:
        with path.open("ab") as file:
            file.write(_HEAD + digest)
    except BaseException:
        os.truncate(path, size)
        raise


def is_intact(path: Path) -> bool | None:
    """Whether a film is what it was when it was sealed; None if it was not, or has lost its end."""
    size = path.stat().st_size
    if size < _SIZE:
        return None
    with path.open("rb") as file:
        file.seek(-_SIZE, os.SEEK_END)
        box = file.read()
    if box[: len(_HEAD)] != _HEAD:
        return None
    return box[len(_HEAD) :] == _digest(path, size - _SIZE)


def _digest(path: Path, size: int) -> bytes:
    """Of the first bytes of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while size > 0 and (block := file.read(min(size, 2**20))):
            digest.update(block)
            size -= len(block)
    return digest.digest()
