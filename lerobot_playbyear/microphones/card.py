"""Sound cards that listen: their clock beside this machine's, their last seconds, and the microphones that share them."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lerobot_playbyear.audio.microphone_pictures import n_kept
from lerobot_playbyear.datasets.features import to_pcm_s16
from lerobot_playbyear.microphones.microphone import CHUNK_S, MicrophoneError, make_microphone

if TYPE_CHECKING:
    from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig

KEPT_S = 10.0
"""How much of a card's sound is kept [s]."""

_USUAL = 0.9  # share of the bursts that come no later than it is reckoned with
_LONGEST_WAIT_S = 0.15
_LATE_S = 0.01  # samples that come later than this, for a quarter of a second, come after others that were lost
_STEADY_S = 1.0  # of sound, over which chunks are compared
_PATIENCE_S = 0.25  # for how long chunks may come late before samples are taken for lost
_FIRST_SOUND_S = 5.0  # how long a card may take until its first chunk; a null sink of PulseAudio takes 2
_SAME_STEP_S = 0.1  # microphones of one card that are read one after the other within this have the same newest sample


class CardClock:
    """Follows a card's clock by the times at which its chunks come.

    A chunk may come late and never early. So the earliest of the last second's, as if the card's rate were exact, tells when
    samples come; it follows a clock that is fast or slow, and a chunk that comes late changes nothing. A burst of chunks that
    were held up ends with one that is not late. Where all chunks of a quarter of a second come late by more than
    10 ms, samples were lost.

    Args:
        sample_rate: What the card says [Hz].
    """

    def __init__(self, sample_rate: int) -> None:
        self._rate = sample_rate
        # Last sample's number + 1, and when sample 0 came by it [s]: only those that no later one undercuts, so the first is
        # the earliest of the last second.
        self._offsets: deque[tuple[int, float]] = deque()
        self._late: list[tuple[int, float]] = []  # those since the last one in time
        self._late_since_s = 0.0

    def note(self, n_written: int, came_s: float) -> int:
        """A chunk came, of which the last sample has the number `n_written - 1`.

        Returns:
            How many samples were lost before; the caller counts them as written.
        """
        offset = came_s - n_written / self._rate
        if self._offsets and offset - self._start > _LATE_S:
            return self._note_late(n_written, offset, came_s)
        self._late = []
        self._keep(n_written, offset)
        while self._offsets[0][0] < n_written - _STEADY_S * self._rate:
            self._offsets.popleft()
        return 0

    def _note_late(self, n_written: int, offset: float, came_s: float) -> int:
        if not self._late:
            self._late_since_s = came_s
        self._late.append((n_written, offset))
        if came_s - self._late_since_s < _PATIENCE_S:
            return 0
        lost = round((min(late for _, late in self._late) - self._start) * self._rate)
        shift = lost / self._rate
        late, self._late = self._late, []
        self._offsets.clear()
        for n, offset_of_late in late:
            self._keep(n + lost, offset_of_late - shift)
        return lost

    def _keep(self, n_written: int, offset: float) -> None:
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((n_written, offset))

    def written_at(self, time_s: float) -> float:
        """How many samples had come at a time, or will have [s of time.perf_counter]; a fraction between two."""
        return (time_s - self._start) * self._rate

    @property
    def _start(self) -> float:
        return self._offsets[0][1]


class CardRecording:
    """What a card has heard in the last seconds, all channels to the same sample.

    Samples have numbers, from 0 at the first one. What the card lost is silence, so that numbers follow the time. One thread
    writes, others read.

    Args:
        name: Of the card, for warnings.
        sample_rate: [Hz].
        channels: How many.

    Attributes:
        written: How many samples there are.
    """

    def __init__(self, name: str, sample_rate: int, channels: int) -> None:
        self._name, self._rate = name, sample_rate
        self._clock = CardClock(sample_rate)
        self._changed = threading.Condition()
        self._kept = np.zeros((round(KEPT_S * sample_rate), channels), np.int16)  # a ring, by number of sample
        self.written = 0
        # Of the last second: when a burst of chunks came, and how long its first sample had waited [s].
        self._bursts: deque[tuple[float, float]] = deque()
        self._came_s = -math.inf
        self._zeros: np.ndarray = np.zeros(channels, np.int64)  # samples at the end of each channel that are exactly 0

    def write(self, chunk: np.ndarray, came_s: float) -> None:
        """Takes a chunk (n, channels), whose last sample came at `came_s` [s of time.perf_counter]."""
        samples = to_pcm_s16(chunk)
        with self._changed:
            self._note_burst(came_s)
            self._kept[self._places(len(samples))] = samples[-len(self._kept) :]
            self.written += len(samples)
            is_sound = samples[::-1] != 0
            self._zeros = np.where(is_sound.any(axis=0), is_sound.argmax(axis=0), self._zeros + len(samples))
            lost = self._clock.note(self.written, came_s)
            if lost:  # known a quarter of a second later: then silence stands where sound goes on
                self._kept[self._places(lost)] = 0
                self.written += lost
                self._bursts.clear()  # which seemed late
            self._changed.notify_all()
        if lost:
            lost_ms = 1e3 * lost / self._rate
            logging.warning("%s lost %.0f ms of sound: the machine or the USB port is too busy.", self._name, lost_ms)

    def heard_at(self, now_s: float) -> int:
        """How many samples had come at a time [s of time.perf_counter], by the card's clock and not by its chunks.

        As far behind as samples usually wait for their chunk, or for the bursts in which a sound server sends chunks; so steps
        have the length that they have in time. Fewer only where chunks are later than that.
        """
        with self._changed:
            if self.written == 0:
                return 0
            waits = sorted(wait for _, wait in self._bursts)
            usual = waits[int(_USUAL * len(waits))] if waits else 0.0
            behind = min(max(usual, CHUNK_S), _LONGEST_WAIT_S)
            return max(min(round(self._clock.written_at(now_s - behind)), self.written), 0)

    def _note_burst(self, came_s: float) -> None:
        """A chunk came; the first one of a burst tells how long samples wait."""
        is_first, self._came_s = came_s - self._came_s > CHUNK_S / 2, came_s
        if is_first and self.written > 0:
            self._bursts.append((came_s, (self._clock.written_at(came_s) - self.written) / self._rate))
        while self._bursts and self._bursts[0][0] < came_s - 1:
            self._bursts.popleft()

    def samples(self, start: int, stop: int) -> np.ndarray:
        """Samples from one number to before another, (n, channels) int16; 0 where they are not kept, or not there yet."""
        numbers = np.arange(start, stop)
        with self._changed:
            found = self._kept[numbers % len(self._kept)]
            is_kept = (numbers >= max(self.written - len(self._kept), 0)) & (numbers < self.written)
        found[~is_kept] = 0
        return found

    def wait_for(self, n_samples: int, timeout_s: float) -> bool:
        """Waits until there are so many samples: whether they came in time [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self.written >= n_samples, timeout_s)

    def zeros_s(self, channel: int) -> float:
        """For how long a channel has given nothing but zeros [s]; no microphone in a room does."""
        return int(self._zeros[channel]) / self._rate

    def _places(self, n: int) -> np.ndarray:
        """Where the next `n` samples lie in the ring; of more than it holds the last ones."""
        return np.arange(self.written + max(n - len(self._kept), 0), self.written + n) % len(self._kept)


class OpenCard:
    """A card that listens, for all microphones that are its channels; as much of its sound is there as a strip takes.

    A card that brings nothing is opened once more: through a sound server a stream that was opened now and then never begins.

    Args:
        config: Of one of them.
        channels: How many to open, at least.

    Raises:
        MicrophoneError: It has fewer, or cannot be opened, or nothing comes from it.
    """

    def __init__(self, config: "MicrophoneCameraConfig", channels: int) -> None:
        self.n_users = 0
        microphone = self.microphone = make_microphone(config, channels)
        if microphone.channels < channels:
            raise MicrophoneError(f"{microphone.name} has {microphone.channels} channels, and {channels} are wanted.")
        self.recording = CardRecording(microphone.name, config.sample_rate, microphone.channels)
        self._step_s, self._step_counter = -math.inf, 0
        self._readers: set[int] = set()  # in this control step
        self._lock = threading.Lock()

        enough = n_kept(microphone.sample_rate) + round(2 * CHUNK_S * microphone.sample_rate)
        try:
            microphone.connect(self.recording.write)
            if not self.recording.wait_for(1, _FIRST_SOUND_S):
                microphone.disconnect()
                microphone.connect(self.recording.write)
            if not self.recording.wait_for(enough, _FIRST_SOUND_S):
                raise MicrophoneError(
                    f"{microphone.name} gave no sound in {_FIRST_SOUND_S:.0f} s, even after it was opened again. Is it "
                    "plugged in? Does another program use it? `playbyear-find-microphones` shows what it hears."
                )
        except BaseException:
            microphone.disconnect()
            raise

    def newest(self, reader: int) -> int:
        """How many samples have come; within a control step, which ends when one reads again, the same for all readers."""
        with self._lock:
            now = time.perf_counter()
            if reader in self._readers or now - self._step_s > _SAME_STEP_S:
                self._readers.clear()
                self._step_s, self._step_counter = now, max(self.recording.heard_at(now), self._step_counter)
            self._readers.add(reader)
            return self._step_counter


_open_cards: dict[Hashable, OpenCard] = {}
_lock = threading.Lock()


def join_card(config: "MicrophoneCameraConfig", channels: Sequence[int]) -> OpenCard:
    """The card of a microphone, which listens from now on if it did not yet.

    Args:
        config: The microphone's options.
        channels: Its channel, and those of all other microphones of the card that were made.

    Raises:
        MicrophoneError: The card cannot be opened, nothing comes from it, or it is open in another way.
    """
    with _lock:
        card = _open_cards.get(config.card) or OpenCard(config, max(channels) + 1)
        card.n_users += 1
        _open_cards[config.card] = card
    microphone = card.microphone
    try:
        if microphone.problem:
            raise MicrophoneError(f"{microphone.name} is gone: {microphone.problem}. Disconnect the others first.")
        if microphone.sample_rate != config.sample_rate:
            raise MicrophoneError(
                f"Microphones of one card ({config.label}) have sample_rate {microphone.sample_rate} and "
                f"{config.sample_rate}: give them the same."
            )
        if config.channel >= microphone.channels:
            raise MicrophoneError(
                f"channel={config.channel} of a microphone ({config.label}): the card is open with {microphone.channels} "
                "channels. Make all of its microphones before one is connected."
            )
    except MicrophoneError:
        leave_card(config, card)
        raise
    return card


def leave_card(config: "MicrophoneCameraConfig", card: OpenCard) -> None:
    """A microphone needs its card no longer; without any the card is closed."""
    with _lock:
        card.n_users -= 1
        if card.n_users == 0:
            _open_cards.pop(config.card, None)
            card.microphone.disconnect()
