"""The sound of one card, cut into the blocks of a control loop's ticks by the clock."""

import threading
import time
from collections.abc import Mapping

import numpy as np

from lerobot_playbyear.datasets.audio_feature import samples_per_frame, to_pcm_s16
from lerobot_playbyear.datasets.microphone import DropOut
from lerobot_playbyear.microphones.clock import CardClock

_KEPT_S = 3.0
_STRETCH = 0.02  # of a block: how much of a drift is made up in one tick, without a gap
_LATE_S = 0.01  # samples that come later than this, for a quarter of a second, come after others that were lost
_SLACK_S = 0.001  # of drift that is left alone: then samples are those that the card gave, bit for bit


class CardRecording:
    """What a card has heard in the last seconds, and blocks of it; all channels to the same sample.

    A block ends at the time that is asked for, and begins where the one before ended. The card's clock is followed: where it
    runs faster or slower than this machine's, a block is stretched by at most 2 %. What cannot be made up so is cut, or filled
    with silence, and noted.

    One thread writes, another reads.

    Args:
        sample_rate: [Hz], a multiple of `fps`.
        fps: Ticks per second [Hz].
        channels: The card's channel of each microphone, by its name.
        timeout_s: How long a block waits for samples that have not come [s].

    Attributes:
        drop_outs: Since the last `restart`.

    Raises:
        ValueError: The rate of ticks does not divide the sample rate.
    """

    def __init__(self, sample_rate: int, fps: int, channels: Mapping[str, int], timeout_s: float = 0.1) -> None:
        self.channels = dict(channels)
        self.drop_outs: list[DropOut] = []
        self._columns = list(channels.values())
        self._rate, self.timeout_s = sample_rate, timeout_s
        self._size = samples_per_frame(sample_rate, fps)
        self._clock = CardClock(sample_rate, tolerance_s=min(_LATE_S, 0.5 / fps))
        self._changed = threading.Condition()
        self._kept = np.zeros((round(_KEPT_S * sample_rate), len(channels)), np.int16)  # a ring, by number of sample
        self._written = 0
        self._stop: int | None = None  # where the last block ended
        self._tick = 0
        self._zeros: np.ndarray = np.zeros(len(channels), np.int64)  # samples at the end of each that are exactly 0

    def write(self, chunk: np.ndarray, came_s: float) -> None:
        """Takes a chunk (n, channels of the card), whose last sample came at `came_s` [s of time.perf_counter]."""
        samples = to_pcm_s16(chunk[:, self._columns])
        with self._changed:
            self._put(samples)
            is_sound = samples[::-1] != 0
            self._zeros = np.where(is_sound.any(axis=0), is_sound.argmax(axis=0), self._zeros + len(samples))
            lost = self._clock.note(self._written, came_s)
            if lost:  # known a quarter of a second later: then silence stands where sound goes on
                self._note(self._written, lost, "lost")
                self._put(np.zeros((min(lost, len(self._kept)), len(self._columns)), np.int16), lost)
            self._changed.notify_all()

    def restart(self, now_s: float) -> None:
        """An episode begins: its first block ends at `now_s`, or is silence as far as nothing was heard then."""
        with self._changed:
            self._tick, self.drop_outs = 0, []
            self._stop = self._place(now_s) - self._size if self._clock.is_set else None

    def forget(self) -> None:
        """The card begins anew, such as after it was plugged in again."""
        with self._changed:
            self._clock.restart()
            self._stop, self._zeros = None, np.zeros_like(self._zeros)

    def skip_to(self, now_s: float) -> None:
        """What was heard until `now_s` belongs to no frame, such as during a pause."""
        with self._changed:
            if self._clock.is_set:
                self._stop = max(self._place(now_s), self._stop or 0)

    def read(self, until_s: float) -> dict[str, np.ndarray]:
        """For each microphone (S,) int16: what was heard since the block before, up to `until_s` [s of time.perf_counter]."""
        with self._changed:
            if not self._clock.is_set:
                self._changed.wait_for(lambda: self._clock.is_set, self.timeout_s)
            if not self._clock.is_set:
                self._note_nothing()
                return {name: np.zeros(self._size, np.int16) for name in self.channels}
            if self._stop is None:
                self._stop = self._place(until_s) - self._size
            self._changed.wait_for(
                lambda: self._written >= self._span(until_s)[1], max(until_s - time.perf_counter(), 0) + self.timeout_s
            )
            start, stop = self._span(until_s)
            if start > self._stop:
                self._note(self._stop, start - self._stop, "skipped")
            heard = max(self._written, start)
            if stop > heard:
                self._note(heard, stop - heard, "late")
            block = self._between(start, stop)
            self._stop, self._tick = stop, self._tick + 1
        return dict(zip(self.channels, np.ascontiguousarray(block.T), strict=True))

    def wait_for_sound(self, timeout_s: float) -> bool:
        """Waits until the card's clock is known: whether a chunk has come in time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._clock.is_set, timeout_s)

    @property
    def zeros_s(self) -> dict[str, float]:
        """For how long each microphone has given nothing but zeros [s]; none in a room does."""
        return {name: int(n) / self._rate for name, n in zip(self.channels, self._zeros, strict=True)}

    def _place(self, time_s: float) -> int:
        return round(self._clock.written_at(time_s))

    def _span(self, until_s: float) -> tuple[int, int]:
        """Where the next block begins and ends: a block on from the last one, or a little more or less after the clock."""
        assert self._stop is not None
        nominal, most = self._stop + self._size, round(_STRETCH * self._size)
        ahead = self._place(until_s) - nominal
        if abs(ahead) <= _SLACK_S * self._rate:
            return self._stop, nominal
        if ahead <= self._size // 2:
            return self._stop, nominal + min(max(ahead, -most), most)
        return self._stop + ahead, nominal + ahead  # far behind: what is between is left out

    def _between(self, start: int, stop: int) -> np.ndarray:
        """The samples from one number to another, (S, microphones) int16; stretched if these are not S."""
        n = stop - start
        numbers = np.arange(start, stop)
        block = self._kept[numbers % len(self._kept)]
        there = (numbers >= max(self._written - len(self._kept), 0)) & (numbers < self._written)
        block[~there] = 0
        if n == self._size:
            return block
        places = (np.arange(self._size) + 0.5) * n / self._size - 0.5
        stretched = np.stack([np.interp(places, np.arange(n), channel) for channel in block.T], axis=1)
        return np.round(stretched).astype(np.int16)

    def _put(self, samples: np.ndarray, n: int | None = None) -> None:
        n = len(samples) if n is None else n
        last = self._written + n
        samples = samples[-len(self._kept) :]
        self._kept[np.arange(last - len(samples), last) % len(self._kept)] = samples
        self._written = last

    def _note_nothing(self) -> None:
        self.drop_outs.append(DropOut(self._tick, self._size, "late"))
        self._tick += 1

    def _note(self, sample: int, n_samples: int, reason: str) -> None:
        if self._stop is not None:
            self.drop_outs.append(DropOut(self._tick + max(sample - self._stop, 0) // self._size, n_samples, reason))
