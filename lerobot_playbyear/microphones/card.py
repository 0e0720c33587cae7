"""The last seconds of one sound card, by number of sample, and when each was heard."""

import logging
import math
import threading
from collections import deque

import numpy as np

from lerobot_playbyear.datasets.features import to_pcm_s16
from lerobot_playbyear.microphones.clock import CardClock

KEPT_S = 10.0
"""How much of a card's sound is kept [s]."""

CHUNK_S = 0.003
"""How often sound is fetched from a card [s]; shorter costs more processor time."""

_USUAL = 0.9  # share of the bursts that come no later than it is reckoned with
_LONGEST_WAIT_S = 0.15
_LATE_S = 0.01  # samples that come later than this, for a quarter of a second, come after others that were lost


class CardRecording:
    """What a card has heard in the last seconds, all channels to the same sample.

    Samples have numbers, from 0 at the first one. What the card lost is silence, so that numbers follow the time. One thread
    writes, others read.

    Args:
        name: Of the card, for warnings.
        sample_rate: [Hz].
        channels: How many.
    """

    def __init__(self, name: str, sample_rate: int, channels: int) -> None:
        self._name, self._rate = name, sample_rate
        self._clock = CardClock(sample_rate, tolerance_s=_LATE_S)
        self._changed = threading.Condition()
        self._kept = np.zeros((round(KEPT_S * sample_rate), channels), np.int16)  # a ring, by number of sample
        self._written = 0
        # Of the last second: when a burst of chunks came, and how long its first sample had waited [s].
        self._bursts: deque[tuple[float, float]] = deque()
        self._came_s = -math.inf
        self._zeros: np.ndarray = np.zeros(channels, np.int64)  # samples at the end of each channel that are exactly 0

    def write(self, chunk: np.ndarray, came_s: float) -> None:
        """Takes a chunk (n, channels), whose last sample came at `came_s` [s of time.perf_counter]."""
        samples = to_pcm_s16(chunk)
        with self._changed:
            self._note_burst(came_s)
            self._put(samples, len(samples))
            is_sound = samples[::-1] != 0
            self._zeros = np.where(is_sound.any(axis=0), is_sound.argmax(axis=0), self._zeros + len(samples))
            lost = self._clock.note(self._written, came_s)
            if lost:  # known a quarter of a second later: then silence stands where sound goes on
                self._put(np.zeros((0, samples.shape[1]), np.int16), lost)
                self._bursts.clear()  # which seemed late
            self._changed.notify_all()
        if lost:
            logging.warning(
                "%s lost %.0f ms of sound: the machine or the USB port is too busy.",
                self._name,
                1e3 * lost / self._rate,
            )

    @property
    def written(self) -> int:
        """How many samples there are."""
        return self._written

    def heard_at(self, now_s: float) -> int:
        """How many samples had come at a time [s of time.perf_counter], by the card's clock and not by its chunks.

        As far behind as samples usually wait for their chunk, or for the bursts in which a sound server sends chunks; so steps
        have the length that they have in time. Fewer only where chunks are later than that.
        """
        with self._changed:
            if not self._clock.is_set:
                return 0
            waits = sorted(wait for _, wait in self._bursts)
            usual = waits[int(_USUAL * len(waits))] if waits else 0.0
            behind = min(max(usual, CHUNK_S), _LONGEST_WAIT_S)
            return max(min(round(self._clock.written_at(now_s - behind)), self._written), 0)

    def _note_burst(self, came_s: float) -> None:
        """A chunk came; the first one of a burst tells how long samples wait."""
        is_first, self._came_s = came_s - self._came_s > CHUNK_S / 2, came_s
        if is_first and self._clock.is_set:
            self._bursts.append((came_s, (self._clock.written_at(came_s) - self._written) / self._rate))
        while self._bursts and self._bursts[0][0] < came_s - 1:
            self._bursts.popleft()

    def samples(self, start: int, stop: int) -> np.ndarray:
        """Samples from one number to before another, (n, channels) int16; 0 where they are not kept, or not there yet."""
        numbers = np.arange(start, stop)
        with self._changed:
            found = self._kept[numbers % len(self._kept)]
            is_kept = (numbers >= max(self._written - len(self._kept), 0)) & (numbers < self._written)
        found[~is_kept] = 0
        return found

    def wait_for(self, n_samples: int, timeout_s: float) -> bool:
        """Waits until there are so many samples: whether they came in time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._written >= n_samples, timeout_s)

    def zeros_s(self, channel: int) -> float:
        """For how long a channel has given nothing but zeros [s]; no microphone in a room does."""
        return int(self._zeros[channel]) / self._rate

    def _put(self, samples: np.ndarray, n: int) -> None:
        """Writes the last `n` samples: those given, after silence."""
        last = self._written + n
        n_kept = min(n, len(self._kept))
        block = np.zeros((n_kept, self._kept.shape[1]), np.int16)
        if len(samples):
            block[-len(samples) :] = samples[-n_kept:]
        self._kept[np.arange(last - n_kept, last) % len(self._kept)] = block
        self._written = last
