"""When the pictures of video files are shown. Run as a program, because decoders crash on some damaged files.

For every file that is named, one line of JSON: the times [s] of all pictures that can be decoded, or what is wrong.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_SECONDS_PER_FILE = 3600


def picture_times(path: Path) -> list[float]:
    """Decodes a video to its end, in a process of its own.

    Args:
        path: The file.

    Returns:
        The times of its pictures [s], in their order.

    Raises:
        ValueError: It cannot be decoded.
    """
    command = [sys.executable, __file__, str(path)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_SECONDS_PER_FILE)
    try:
        answer = json.loads(result.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        raise ValueError("it makes the decoder crash") from None
    if "problem" in answer:
        raise ValueError(answer["problem"])
    return sorted(answer["times"])


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
