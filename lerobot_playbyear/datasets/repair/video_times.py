"""When the pictures of video files are shown. Run as a program, because decoders crash on some damaged files.

For every file that is named, one line of JSON: the times [s] of all pictures that can be decoded, or what is wrong, or
why the file cannot be read now.
"""

import contextlib
import errno
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_CRASHES = {
    -getattr(signal, name)
    for name in ("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT", "SIGTRAP")
    if hasattr(signal, name)
}
_ENOUGH_BYTES = 2**28  # more than a decoder takes for a sound film's headers


def picture_times(names: Iterable[Path], root: Path) -> dict[Path, list[float] | str]:
    """Decodes videos to their end, in a process of its own.

    Args:
        names: The files.
        root: What their names are relative to.

    Returns:
        For each file the times of its pictures [s], in order, or why it cannot be decoded.

    Raises:
        OSError: A file cannot be read now, or the process was ended by something else than the file.
    """
    answers: dict[Path, list[float] | str] = {}
    left = sorted(names)
    while left:
        command = [sys.executable, __file__, *(str(root / name) for name in left)]
        result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
        lines = [json.loads(line) for line in result.stdout.splitlines() if line.endswith("}")]
        for name, answer in zip(left, lines, strict=False):
            if "unreadable" in answer:
                number, reason = answer["unreadable"]
                raise OSError(number, reason, str(root / name))
            answers[name] = answer["problem"] if "problem" in answer else sorted(answer["times"])
        if len(lines) < len(left):
            name = left[len(lines)]
            if result.returncode not in _CRASHES:
                reason = f"the decoder ended with {result.returncode}, as where memory is short"
                raise ChildProcessError(errno.ECHILD, reason, str(root / name))
            answers[name] = "it makes the decoder crash"
        left = left[len(lines) + 1 :]
    return answers


class _Film(io.FileIO):
    """A file that remembers that it could not be read: FFmpeg takes some errors for the film's end.

    Attributes:
        problem: The error.
    """

    problem: OSError | None = None

    def read(self, size: int | None = -1, /) -> bytes:
        try:
            return super().read(size if size is not None else -1) or b""
        except OSError as error:
            self.problem = error
            raise


def _decode(path: str) -> dict[str, Any]:
    try:
        with _Film(path) as film:
            answer = _decode_film(film)
            if film.problem is not None:
                raise film.problem
            return answer
    except OSError as error:
        number = error.errno or errno.EIO
        return {"unreadable": [number, os.strerror(number)]}


def _decode_film(film: _Film) -> dict[str, Any]:
    import av

    times: list[float] = []
    try:
        with av.open(film, mode="r") as container:
            if not container.streams.video:
                return {"problem": "it holds no video"}
            for packet in container.demux(container.streams.video[0]):
                pictures: list[Any] = []
                with contextlib.suppress(av.FFmpegError):  # what it held is missing from the times
                    pictures += packet.decode()
                times += [
                    picture.time
                    for picture in pictures
                    if isinstance(picture, av.VideoFrame) and picture.time is not None and not picture.is_corrupt
                ]
    except Exception as error:  # what FFmpeg makes of wrong bytes, of which there are many kinds
        if isinstance(error, MemoryError) and not _has_memory():
            raise OSError(errno.ENOMEM, "") from error
        if not times:
            return {"problem": f"{type(error).__name__}: {error}"}
    return {"times": times}


def _has_memory() -> bool:
    """Whether there is memory: FFmpeg also says that there is none where a film asks for too much."""
    try:
        return len(bytearray(_ENOUGH_BYTES)) > 0
    except MemoryError:
        return False


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(json.dumps(_decode(argument)), flush=True)
