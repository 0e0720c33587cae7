"""The latency of sound beside pictures, from the motion in pictures and the level of sound. Nothing here needs a device."""

from dataclasses import dataclass

import numpy as np

from lerobot_playbyear.datasets.errors import PlaybyearError

FEWEST_TAPS = 5
MOST_SPREAD_S = 0.025
EVENTS = ("stops", "begins")

_QUIET_S = 0.25  # between two taps, at least: of sound, and of motion
_FARTHEST_S = 0.6  # from a sound to the motion that belongs to it
_FRACTION_OF_PEAK = 0.15  # of motion, above which something moves
_LOUDER = 8.0  # than the background is a tap
_JITTER_S = 0.002  # by which single sounds are off
_SPREAD_OF_PICTURES = 0.45  # of the time between two, which slow cameras cause by themselves
_OUTLIER = 3.0  # spreads


class CalibrationError(PlaybyearError, RuntimeError):
    """The taps do not tell the latency; the message says why, and what to do."""


@dataclass(frozen=True)
class Tap:
    """A tap that was seen and heard.

    Args:
        heard_s: When its sound begins, by the time at which it arrived [s].
        after_s, until_s: Between these the picture's moment lies [s].
    """

    heard_s: float
    after_s: float
    until_s: float

    @property
    def latency_s(self) -> float:
        """How much later its sound is than the middle of when it was seen [s]."""
        return self.heard_s - (self.after_s + self.until_s) / 2


@dataclass(frozen=True)
class Latency:
    """How much later sound arrives than pictures.

    Args:
        latency_s: The latency [s]; below 0 the picture is later.
        median_s: Of the single taps [s].
        spread_s: Their median absolute deviation [s]; a quarter of a picture's time comes from the camera's rate alone.
        resolution_s: How far the latency can be off with what was seen [s].
        taps: Those that were used.
        n_heard: How many sounds there were.
    """

    latency_s: float
    median_s: float
    spread_s: float
    resolution_s: float
    taps: tuple[Tap, ...]
    n_heard: int


def sound_onsets(times_s: np.ndarray, level: np.ndarray) -> np.ndarray:
    """When sounds begin that stand out.

    Args:
        times_s: (n,) [s], ascending, about a millisecond apart.
        level: (n,), such as the largest change between two samples.

    Returns:
        (k,) [s].
    """
    if len(level) == 0 or level.max() <= 0:
        return np.zeros(0)
    threshold = max(_LOUDER * float(np.median(level)), 0.1 * float(level.max()))
    loud = np.flatnonzero(level > threshold)
    first = loud[np.diff(times_s[loud], prepend=-np.inf) > _QUIET_S]
    onsets = []
    for index in first:
        peak = level[index : index + 10].max()
        begin = max(index - 10, 0)
        rising = np.flatnonzero(level[begin : index + 10] > 0.2 * peak)
        onsets.append(times_s[begin + rising[0]])
    return np.array(onsets)


def motion_intervals(times_s: np.ndarray, motion: np.ndarray, event: str) -> np.ndarray:
    """Between which times motions stop, or begin.

    A picture shows that something has moved since the one before, not when. So every motion gives an interval as long as a
    picture's time, and taps at different moments between pictures narrow it down.

    Args:
        times_s: (n,) of the pictures [s], ascending.
        motion: (n,) how much each picture differs from the one before.
        event: "stops": the sound comes when a motion ends. "begins": when it begins, as a flash does.

    Returns:
        (k, 2) [s].
    """
    if len(motion) < 3 or motion.max() <= 0:
        return np.zeros((0, 2))
    floor = float(np.median(motion))
    moving = np.flatnonzero(motion - floor > _FRACTION_OF_PEAK * (_usual_peak(motion) - floor))
    parts = np.split(moving, np.flatnonzero(np.diff(times_s[moving]) > _QUIET_S) + 1)
    chosen = np.array([part[0] if event == "begins" else part[-1] for part in parts])
    chosen = chosen[chosen > 0]
    intervals = np.stack([times_s[chosen - 1], times_s[chosen]], axis=1)
    if (
        event == "stops"
    ):  # a hand that stopped in the first part of a picture's time has moved too little to be seen in it
        intervals += _FRACTION_OF_PEAK * (intervals[:, 1:] - intervals[:, :1])
    return intervals


def estimate_latency(
    picture_times_s: np.ndarray, motion: np.ndarray, sound_times_s: np.ndarray, level: np.ndarray, event: str = "stops"
) -> Latency:
    """How much later sound arrives than pictures.

    Every tap says that the latency lies in an interval as long as a picture's time. The latency is the middle of what most of
    them agree on, which is finer than that.

    Args:
        picture_times_s: (n,) when pictures arrived [s].
        motion: (n,) how much each differs from the one before.
        sound_times_s: (m,) when sound arrived [s], about a millisecond apart.
        level: (m,) of sound.
        event: As of `motion_intervals`.

    Raises:
        CalibrationError: Too few taps, or they do not agree.
    """
    onsets = sound_onsets(sound_times_s, level)
    intervals = motion_intervals(picture_times_s, motion, event)
    seen_and_heard = _pairs(onsets, intervals)
    what = f"{len(onsets)} sounds and {len(intervals)} motions"
    if len(seen_and_heard) < FEWEST_TAPS:
        raise CalibrationError(
            f"{what} were noticed, and {len(seen_and_heard)} belong together; {FEWEST_TAPS} are needed. Tap louder, with "
            "nothing else that moves in the picture or sounds, a second between two taps."
        )
    taps = _without_outliers(seen_and_heard)
    latencies = np.array([tap.latency_s for tap in taps])
    median = float(np.median(latencies))
    spread = float(np.median(np.abs(latencies - median)))
    most = max(MOST_SPREAD_S, _SPREAD_OF_PICTURES * float(np.median([tap.until_s - tap.after_s for tap in taps])))
    if len(taps) < max(FEWEST_TAPS, len(seen_and_heard) / 2) or spread > most:
        raise CalibrationError(
            f"{what} were noticed, and the latency of sound is {median * 1000:.0f} ms with a spread of {spread * 1000:.0f} ms, "
            f"from {len(taps)} taps; wanted at most {most * 1000:.0f} ms. Tap briefly, and rest between two taps; a "
            "camera with more pictures a second helps. --event says whether motion stops or begins with the sound."
        )
    latency, resolution = _agreed(taps)
    return Latency(latency, median, spread, resolution, tuple(taps), len(onsets))


def _usual_peak(motion: np.ndarray) -> float:
    """How much a tap moves; a single picture that is disturbed does not set it."""
    return float(np.sort(motion)[-min(5, len(motion)) :].mean())


def _pairs(onsets: np.ndarray, intervals: np.ndarray) -> list[Tap]:
    """To each sound the nearest motion, if none is nearer to that."""
    if len(onsets) == 0 or len(intervals) == 0:
        return []
    away = np.abs(onsets[:, None] - intervals.mean(axis=1)[None])  # (sounds, motions)
    nearest = away.argmin(axis=1)
    return [
        Tap(float(onset), *map(float, intervals[motion]))
        for sound, (onset, motion) in enumerate(zip(onsets, nearest, strict=True))
        if away[sound, motion] <= _FARTHEST_S and away[:, motion].argmin() == sound
    ]


def _without_outliers(taps: list[Tap]) -> list[Tap]:
    latencies = np.array([tap.latency_s for tap in taps])
    away = np.abs(latencies - np.median(latencies))
    usual_width = float(np.median([tap.until_s - tap.after_s for tap in taps]))
    most = max(_OUTLIER * 1.4826 * float(np.median(away)), usual_width)
    return [tap for tap, distance in zip(taps, away, strict=True) if distance <= most]


def _agreed(taps: list[Tap]) -> tuple[float, float]:
    """The middle of the latencies that most taps allow, and how many they are [s]."""
    lows = np.array([tap.heard_s - tap.until_s for tap in taps]) - _JITTER_S
    highs = np.array([tap.heard_s - tap.after_s for tap in taps]) + _JITTER_S
    tried = np.arange(lows.min(), highs.max(), 0.0005)
    votes = ((tried[:, None] >= lows) & (tried[:, None] <= highs)).sum(axis=1)
    best = tried[votes == votes.max()]
    return float(np.median(best)), float(best[-1] - best[0])
