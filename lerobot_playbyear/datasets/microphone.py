"""From a sound card's callback, which brings chunks of any length at any time, to one block of samples per frame."""

import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_playbyear.datasets.audio_feature import samples_per_frame, to_pcm_s16

_DRIFT = 0.01  # of a chunk's deviation from where it was expected


@dataclass(frozen=True)
class DropOut:
    """Sound that is not what was heard.

    Args:
        frame: The frame, counted from the episode's first, in whose block it begins.
        n_samples: How many samples.
        reason: "lost" when the sound card skipped them and "late" when they had not come in time: silence is in
            their place. "skipped" when there were more samples than time had passed: they are left out.
    """

    frame: int
    n_samples: int
    reason: str


class SoundCardBuffer:
    """Collects what the microphones of one sound card hear, and hands it out frame by frame, all to the same sample.

    The card's channels share one clock and one beginning: sample n of one microphone was heard with sample n of the others, and
    what is lost, cut or late is so for all. Two buffers of one card would begin at different samples, a chunk apart, for the
    whole recording. The blocks of an episode have no gaps.

    One thread writes, another reads. The sound card's clock and the frames' differ a little: where the samples run
    ahead of the frames by more than `max_lag` they are cut, and where they run behind for longer than `timeout`
    silence is put in. Every such place is noted in `drop_outs`.

    Args:
        sample_rate: Samples per second [Hz], a multiple of `fps`.
        fps: Frames per second [Hz].
        channels: The card's channel of each microphone, counted from 0, by whatever name `read_frame` shall give it, such as
            `{"observation.audio.left": 0, "observation.audio.right": 1}`. Other channels are left out.
        reserve: How far the sound stays behind the frames [s], so that a chunk that comes a little late makes no
            frame wait. A chunk's duration is enough.
        max_lag: How far the sound may be behind the frames [s] before it is cut to catch up.
        timeout: How long `read_frame` waits for samples that have not come [s].

    Attributes:
        drop_outs: Since the last `reset`, of all microphones alike.

    Raises:
        ValueError: The frame rate does not divide the sample rate, a time is out of range, or two microphones have the same
            channel, or none has one.
    """

    def __init__(
        self,
        sample_rate: int,
        fps: int,
        channels: Mapping[str, int],
        reserve: float = 0.02,
        max_lag: float = 0.2,
        timeout: float = 0.1,
    ) -> None:
        if not 0 <= reserve < max_lag:
            raise ValueError(f"reserve={reserve}: it must be at least 0 and less than max_lag={max_lag}.")
        if not channels or len(set(channels.values())) < len(channels) or min(channels.values()) < 0:
            raise ValueError(f"channels={dict(channels)}: give every microphone a channel of its own, counted from 0.")
        self.sample_rate = sample_rate
        self.channels = dict(channels)
        self.drop_outs: list[DropOut] = []
        self._columns = list(channels.values())
        self._size = samples_per_frame(sample_rate, fps)
        self._timeout = timeout
        self._reserve = round(reserve * sample_rate)
        self._max_lag = round(max_lag * sample_rate)
        self._changed = threading.Condition()
        self._start: float | None = None  # when sample 0 was heard, by the chunks' timestamps
        self._kept = np.zeros((0, len(channels)), np.int16)  # the samples before `_written`
        self._written = 0  # number of the next sample to come
        self._owed = 0  # samples that are still to come, and silence was put in for
        self._read: int | None = None  # number of the next sample to hand out; None before the first frame
        self._frame = 0

    def write(self, chunk: np.ndarray, timestamp: float | None = None) -> None:
        """Takes what the sound card brings. May be called from its thread; copies the samples.

        Args:
            chunk: (n, channels of the card), int16 PCM or floats in [-1, 1].
            timestamp: When the first of these samples was heard [s]. With it, samples that the sound card lost are
                noticed, from half a frame on; without it they shift all that follows.

        Raises:
            ValueError: It has another shape or dtype.
        """
        chunk = np.asarray(chunk)
        if chunk.ndim != 2 or chunk.shape[1] <= max(self._columns):
            raise ValueError(
                f"A chunk has shape {chunk.shape}; wanted (n, channels of the card), with the channels {self.channels}. "
                "Open the card with as many channels."
            )
        samples = to_pcm_s16(chunk[:, self._columns])
        with self._changed:
            lost = 0 if timestamp is None else self._lost_before(timestamp, len(samples))
            late = min(self._owed, lost + len(samples))  # silence is in their place already
            self._owed -= late
            self._append_silence(max(lost - late, 0))
            self._append(samples[max(late - lost, 0) :])
            self._changed.notify_all()

    def read_frame(self) -> dict[str, np.ndarray]:
        """The blocks of the frame that is taken now: for each microphone (S,) int16, the samples since the frame before.

        The first block after a `reset` holds the newest samples but the reserve; silence where there are not enough
        yet. By the reserve and the sound card's own latency the blocks are behind the frames.
        """
        with self._changed:
            if self._read is None:
                self._read = self._written - self._size - self._reserve
            ahead = self._written - self._read - self._size
            if ahead > self._max_lag:
                self._note(self._read, ahead - self._reserve, "skipped")
                self._read += ahead - self._reserve
            stop = self._read + self._size
            self._changed.wait_for(lambda: self._written >= stop, self._timeout)
            if self._written < stop:
                late = stop - self._written
                self._note(self._written, late, "late")
                if self._start is not None:  # then it shows whether they still come
                    self._owed += late
                self._append_silence(late)
            first = self._written - len(self._kept)  # the number of the oldest sample there is
            blocks = np.zeros((len(self._columns), self._size), np.int16)
            found = self._kept[max(self._read - first, 0) : max(stop - first, 0)]
            blocks[:, self._size - len(found) :] = found.T
            self._read = stop
            self._frame += 1
            return dict(zip(self.channels, blocks, strict=True))

    def reset(self) -> None:
        """Begins a new episode: the next frame is its first."""
        with self._changed:
            self._read = None
            self._frame = 0
            self.drop_outs = []

    def _append(self, samples: np.ndarray) -> None:
        self._written += len(samples)
        self._kept = np.concatenate([self._kept, samples])[-(self._size + self._max_lag) :]

    def _append_silence(self, n_samples: int) -> None:
        kept = min(n_samples, self._size + self._max_lag)  # a card that slept for hours would ask for gigabytes
        self._written += n_samples - kept
        self._append(np.zeros((kept, len(self._columns)), np.int16))

    def _lost_before(self, timestamp: float, n_samples: int) -> int:
        """How many samples the sound card lost before a chunk, by the chunk's time."""
        expected = self._written - self._owed
        if self._start is None:
            self._start = timestamp - expected / self.sample_rate
        ahead = (timestamp - self._start) * self.sample_rate - expected
        if ahead <= max(n_samples, self._size) / 2:  # the clocks' unsteadiness, and how they slowly drift apart
            self._start += _DRIFT * ahead / self.sample_rate
            return 0
        self._note(expected, round(ahead), "lost")
        return round(ahead)

    def _note(self, sample: int, n_samples: int, reason: str) -> None:
        if self._read is not None:
            frame = self._frame + max(sample - self._read, 0) // self._size
            self.drop_outs.append(DropOut(frame, n_samples, reason))


class MicrophoneBuffer:
    """A `SoundCardBuffer` for the only microphone of a sound card.

    Stereo, or several microphones on the channels of one card, need one `SoundCardBuffer`: two of these for one card are up
    to a chunk apart.

    Args:
        sample_rate, fps: Samples and frames per second [Hz]; the first is a multiple of the second.
        reserve, max_lag, timeout: As of `SoundCardBuffer` [s].

    Attributes:
        sample_rate: Samples per second [Hz].

    Raises:
        ValueError: The frame rate does not divide the sample rate, or a time is out of range.
    """

    def __init__(
        self,
        sample_rate: int,
        fps: int,
        reserve: float = 0.02,
        max_lag: float = 0.2,
        timeout: float = 0.1,
    ) -> None:
        self._card = SoundCardBuffer(sample_rate, fps, {"microphone": 0}, reserve, max_lag, timeout)
        self.sample_rate = sample_rate

    @property
    def drop_outs(self) -> list[DropOut]:
        """Sound since the last `reset` that is not what was heard."""
        return self._card.drop_outs

    def write(self, chunk: np.ndarray, timestamp: float | None = None) -> None:
        """As `SoundCardBuffer.write`, with chunks of shape (n,) or (n, 1).

        Raises:
            ValueError: It has another shape or dtype.
        """
        chunk = np.asarray(chunk)
        if chunk.ndim != 1 and chunk.shape[1:] != (1,):
            raise ValueError(
                f"A chunk of one microphone has shape {chunk.shape}; wanted (n,) or (n, 1). Several channels of one card: "
                "SoundCardBuffer."
            )
        self._card.write(chunk.reshape(-1, 1), timestamp)

    def read_frame(self) -> np.ndarray:
        """As `SoundCardBuffer.read_frame`: (S,) int16."""
        return self._card.read_frame()["microphone"]

    def reset(self) -> None:
        """Begins a new episode: the next frame is its first."""
        self._card.reset()
