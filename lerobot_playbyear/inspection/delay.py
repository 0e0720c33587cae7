"""How much later sound comes than the pictures, from taps and other contacts that are seen and heard.

Method. A contact is heard as a sudden sound (`onsets.py`), and seen as a motion that ends: the difference of a picture from
the one before, which stood out, no longer does. A picture shows that something moved since the one before, not when, so each
contact allows delays of one picture's time. The delay is the middle of what most contacts allow, which is finer than that.
Where too few contacts agree, nothing is said.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from lerobot_playbyear.inspection.onsets import STEP_S, sudden_sounds
from lerobot_playbyear.inspection.source import DatasetSource
from lerobot_playbyear.inspection.verdict import Verdict

_FEWEST = 5  # contacts
_AGREEING = 2 / 3  # of the contacts, at least
_QUIET_S = 0.25  # between two contacts, at least: of sound, and of motion
_FARTHEST_S = 0.6  # from a sound to the motion that belongs to it
_STANDS_OUT = 3.0  # times the usual difference of two pictures: a motion's largest
_SHARE_OF_PEAK = 0.15  # of a motion's largest difference, above which something moves
_JITTER_S = STEP_S / 2 + 0.001  # by which single sounds are off
_WIDEST = 160  # pixels that are looked at; a hand is larger


def difference(picture: np.ndarray, before: np.ndarray) -> float:
    """How much a picture (H, W, 3) uint8 differs from the one before, in grey levels."""
    step = max(picture.shape[1] // _WIDEST, 1)
    small = [image[::step, ::step].astype(np.int16) for image in (picture, before)]
    return float(np.abs(small[0] - small[1]).mean())


def check_delay(
    source: DatasetSource, microphones: Sequence[str], motion: Mapping[str, Sequence[Sequence[float]]]
) -> Iterator[Verdict]:
    """How much later the sound of each microphone comes than each camera's pictures, where contacts tell it.

    Args:
        source: The dataset.
        microphones: Whose rows are what their sample rate says.
        motion: Of each camera and episode how much every picture differs from the one before (`difference`).
    """
    for key in microphones:
        sounds = [source.sound(key, episode) for episode in source.episodes]
        # Row i ends with picture i: the first row was heard before the first picture.
        heard = [
            _apart(sudden_sounds(s, s.samples_per_frame * source.fps)) + STEP_S / 2 - 1 / source.fps for s in sounds
        ]
        for camera, episodes in motion.items():
            seen = [_motion_ends(np.asarray(each), source.fps) for each in episodes]
            contacts = np.concatenate([np.zeros((0, 2)), *map(_delays, heard, seen)])  # (k, 2) [s]
            if len(contacts) >= _FEWEST:
                yield from _told(contacts, key, camera)


def _apart(times_s: np.ndarray) -> np.ndarray:
    """Those [s] that come after a time without one."""
    return times_s[np.diff(times_s, prepend=-np.inf) > _QUIET_S]


def _motion_ends(motion: np.ndarray, fps: int) -> np.ndarray:
    """Between which times motions end, (k, 2) [s]."""
    floor = float(np.median(motion)) if len(motion) else 0.0
    peak = float(np.sort(motion)[-5:].mean()) if len(motion) else 0.0  # a single disturbed picture does not set it
    if not peak > _STANDS_OUT * floor:
        return np.zeros((0, 2))
    moving = np.flatnonzero(motion > floor + _SHARE_OF_PEAK * (peak - floor))
    last = moving[np.diff(moving, append=np.inf) > _QUIET_S * fps]
    # What stopped in the first part of a picture's time has moved too little to be seen in it.
    return (np.stack([last - 1, last], axis=1) + _SHARE_OF_PEAK) / fps


def _delays(heard: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The least and the largest delay [s] that each contact allows, (k, 2): to a sound belongs the nearest motion."""
    if len(heard) == 0 or len(seen) == 0:
        return np.zeros((0, 2))
    away = np.abs(heard[:, None] - seen.mean(axis=1))  # (sounds, motions)
    nearest = away.argmin(axis=1)
    own = (away[:, nearest].argmin(axis=0) == np.arange(len(heard))) & (away.min(axis=1) <= _FARTHEST_S)
    return (heard[:, None] - seen[nearest, ::-1])[own]


def _told(contacts: np.ndarray, microphone: str, camera: str) -> Iterator[Verdict]:
    lows, highs = contacts[:, 0] - _JITTER_S, contacts[:, 1] + _JITTER_S
    tried = np.arange(lows.min(), highs.max(), 0.0005)
    votes = ((tried[:, None] >= lows) & (tried[:, None] <= highs)).sum(axis=1)
    delay = float(np.median(tried[votes == votes.max()]))
    agreeing = contacts[(lows <= delay) & (delay <= highs)].mean(axis=1)
    if len(agreeing) < max(_FEWEST, _AGREEING * len(contacts)):
        return
    spread = float(np.median(np.abs(agreeing - np.median(agreeing))))
    side = "after" if delay >= 0 else "before"
    message = (
        f"sound comes {abs(delay) * 1000:.0f} ms {side} the picture of {camera} (spread {spread * 1000:.0f} ms, "
        f"{len(agreeing)} contacts)"
    )
    figures = {"delay_s": round(delay, 4), "spread_s": round(spread, 4), "contacts": len(agreeing)}
    yield Verdict("sound and picture", "info", message, microphone, figures=figures)
