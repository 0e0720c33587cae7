"""When the pictures of video files are shown. Run as a program, because decoders crash on some damaged files.

For every file that is named, one line of JSON: the times [s] of all pictures that can be decoded, or what is wrong.
"""

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any


def picture_times(names: Iterable[Path], root: Path) -> dict[Path, list[float] | str]:
    """Decodes videos to their end, in a process of its own.

    Args:
        names: The files.
        root: What their names are relative to.

    Returns:
        For each file the times of its pictures [s], in order, or why it cannot be decoded.
    """
    answers: dict[Path, list[float] | str] = {}
    left = sorted(names)
    while left:
        command = [sys.executable, __file__, *(str(root / name) for name in left)]
        result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=False)
        lines = [json.loads(line) for line in result.stdout.splitlines() if line.endswith("}")]
        for name, answer in zip(left, lines, strict=False):
            answers[name] = answer["problem"] if "problem" in answer else sorted(answer["times"])
        if len(lines) < len(left):
            answers[left[len(lines)]] = "it makes the decoder crash"
        left = left[len(lines) + 1 :]
    return answers


def _decode(path: str) -> dict[str, Any]:
    import av

    times: list[float] = []
    try:
        with av.open(path) as container:
            if not container.streams.video:
                return {"problem": "it holds no video"}
            for packet in container.demux(container.streams.video[0]):
                pictures: list[Any] = []
                try:
                    pictures += packet.decode()
                except av.FFmpegError:
                    continue  # what it held is missing from the times
                times += [
                    picture.time
                    for picture in pictures
                    if isinstance(picture, av.VideoFrame) and picture.time is not None and not picture.is_corrupt
                ]
    except (av.FFmpegError, OSError, ValueError, IndexError, MemoryError) as error:
        if not times:
            return {"problem": f"{type(error).__name__}: {error}"}
    return {"times": times}


def main(paths: Sequence[str]) -> None:
    for path in paths:
        print(json.dumps(_decode(path)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
