"""The pictures of a video, one after the other; LeRobot's decoder holds all of them, and a table of their distances."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import av
import numpy as np
from lerobot.datasets.video_utils import FrameTimestampError, decode_video_frames
from lerobot.utils.import_utils import get_safe_default_video_backend

from lerobot_playbyear.datasets.confines import has_shape

_AT_ONCE = 64  # pictures


def video_pictures(
    path: Path,
    times: Sequence[float],
    tolerance_s: float,
    video_backend: str | None = None,
    key: str = "",
    shape: Sequence[int] | None = None,
) -> Iterator[np.ndarray]:
    """Decodes the pictures that are shown at these times, the same as LeRobot's `decode_video_frames` gives.

    Args:
        path: The video.
        times: When [s].
        tolerance_s: How far a picture's time may be from the one wanted [s], besides the rounding of LeRobot's
            timestamps to 32 bits.
        video_backend: LeRobot's decoder ("pyav", "torchcodec"); None takes its default.
        key: The camera, for the message.
        shape: Its feature's; None: pictures of any size are decoded.

    Returns:
        For each time a picture, (H, W, 3) uint8.

    Raises:
        FrameTimestampError: There is no picture at one of these times.
        ValueError: The pictures have another size than the feature says; none of that size is taken out of the video.
    """
    check = partial(_check_size, path, key, shape)
    backend = video_backend or get_safe_default_video_backend()
    if backend == "pyav" and all(before <= after for before, after in itertools.pairwise(times)):
        yield from _walk(path, times, tolerance_s, check)
        return
    with av.open(str(path)) as container:
        check(container.streams.video[0].height, container.streams.video[0].width)
    for first in range(0, len(times), _AT_ONCE):
        wanted = list(times[first : first + _AT_ONCE])
        frames = decode_video_frames(path, wanted, tolerance_s, backend, return_uint8=True)  # (n, C, H, W)
        check(*frames.shape[2:])
        yield from frames.permute(0, 2, 3, 1).numpy()


def _check_size(path: Path, key: str, shape: Sequence[int] | None, height: int, width: int) -> None:
    if shape is not None and not has_shape(height, width, shape):
        raise ValueError(
            f"'{key}': the pictures of '{path}' have {width} x {height} pixels; meta/info.json gives the shape "
            f"{tuple(shape)}. Correct the shape, or record the dataset again."
        )


def _walk(
    path: Path, times: Sequence[float], tolerance_s: float, check: Callable[[int, int], None]
) -> Iterator[np.ndarray]:
    """From the first time to the last, with two pictures in memory. The times must be in order."""
    if not times:
        return
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.time_base is not None
        check(stream.height, stream.width)
        container.seek(round(times[0] / stream.time_base) - 1, backward=True, any_frame=False, stream=stream)
        frames = (frame for frame in container.decode(stream) if frame.pts is not None)
        before = after = next(frames, None)
        for time in times:
            while after is not None and _time(after) < time:
                before, after = after, next(frames, None)
            near = [frame for frame in (before, after) if frame is not None]
            if not near:
                raise FrameTimestampError(f"{path} has no picture that can be decoded at {time:.4f} s or after it.")
            frame = min(near, key=lambda frame: abs(_time(frame) - time))
            if abs(_time(frame) - time) >= tolerance_s + float(np.spacing(np.float32(time))):
                raise FrameTimestampError(
                    f"{path} has no picture at {time:.4f} s (tolerance {tolerance_s:g} s); the nearest one is at "
                    f"{_time(frame):.4f} s."
                )
            check(frame.height, frame.width)  # which may change on the way
            yield frame.to_ndarray(format="rgb24")


def _time(frame: av.VideoFrame) -> float:
    assert frame.time is not None
    return frame.time
