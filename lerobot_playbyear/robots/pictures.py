"""The pictures of a robot's cameras: which one is frozen, and how a person sees them."""

import time
from collections.abc import Mapping

import numpy as np

_MOST_SHOWN = 720  # pixels


class FrozenCameras:
    """Notices a camera that gives the same picture to the last bit, which no real one does.

    Args:
        after_s: For how long [s]; 0: never.
    """

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._same: dict[str, tuple[int, float]] = {}

    def restart(self) -> None:
        """A new attempt."""
        self._same.clear()

    def problem(self, pictures: Mapping[str, np.ndarray]) -> str:
        """Why a camera is taken for dead, if one is."""
        now = time.perf_counter()
        for name, picture in pictures.items() if self._after_s else ():
            seen = hash(picture[::8, ::8].tobytes())
            before, since = self._same.get(name, (None, now))
            self._same[name] = (seen, since if seen == before else now)
            if now - self._same[name][1] > self._after_s:
                return f"The camera {name} has given the same picture for {self._after_s:.1f} s."
        return ""


def side_by_side(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """All cameras, (side, side, 3) uint8: a square, as the window shows, of at most 720 pixels."""
    shown = list(pictures.values()) or [np.zeros((64, 64, 3), np.uint8)]
    height, width = max(p.shape[0] for p in shown), sum(p.shape[1] for p in shown)
    step, side = -(-max(height, width) // _MOST_SHOWN), max(height, width)
    scene, left = np.zeros((side, side, 3), np.uint8), (side - width) // 2
    for picture in shown:
        top = (side - picture.shape[0]) // 2
        scene[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
        left += picture.shape[1]
    return np.ascontiguousarray(scene[::step, ::step])
