"""Sound cards that listen, and the microphones that share them."""

import math
import threading
import time
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

from lerobot_playbyear.audio.sample_strip import n_kept
from lerobot_playbyear.microphones.card import CHUNK_S, CardRecording
from lerobot_playbyear.microphones.microphone import MicrophoneError

if TYPE_CHECKING:
    from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig

_FIRST_SOUND_S = 5.0  # how long a card may take until its first chunk; a null sink of PulseAudio takes 2
_SAME_STEP_S = 0.1  # microphones of one card that are read one after the other within this have the same newest sample


class OpenCard:
    """A card that listens, for all microphones that are its channels.

    Args:
        config: Of one of them.
        channels: How many to open, at least.

    Raises:
        MicrophoneError: It has fewer.
    """

    def __init__(self, config: "MicrophoneCameraConfig", channels: int) -> None:
        self.n_users = 0
        self.microphone = config.make(channels)
        if self.microphone.channels < channels:
            raise MicrophoneError(
                f"{self.microphone.name} gives {self.microphone.channels} channels, wanted {channels}."
            )
        self.recording = CardRecording(self.microphone.name, config.sample_rate, self.microphone.channels)
        self._step_s, self._step_counter = -math.inf, 0
        self._readers: set[int] = set()  # in this control step
        self._lock = threading.Lock()

    def open(self) -> None:
        """Listens, and waits until a strip's sound is there. A card that brings nothing is opened once more: through a sound
        server a stream that was opened now and then never begins."""
        enough = n_kept(self.microphone.sample_rate) + round(2 * CHUNK_S * self.microphone.sample_rate)
        try:
            self.microphone.connect(self.recording.write)
            if not self.recording.wait_for(1, _FIRST_SOUND_S):
                self.microphone.disconnect()
                self.microphone.connect(self.recording.write)
            if not self.recording.wait_for(enough, _FIRST_SOUND_S):
                raise MicrophoneError(
                    f"From {self.microphone.name} nothing came in {_FIRST_SOUND_S:.0f} s, and nothing after it was opened "
                    "again. Is it plugged in, and used by no other program? `playbyear-find-microphones` shows what it hears."
                )
        except BaseException:
            self.microphone.disconnect()
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


def join_card(config: "MicrophoneCameraConfig", channels: Sequence[int], name: str) -> OpenCard:
    """The card of a microphone, which listens from now on if it did not yet.

    Args:
        config: The microphone's options.
        channels: Its channel, and those of all other microphones of the card that were made.
        name: Of the microphone, for messages.

    Raises:
        MicrophoneError: The card cannot be opened, nothing comes from it, or it is open in another way.
    """
    with _lock:
        card = _open_cards.get(config.card)
        if card is None:
            card = _open_cards[config.card] = _opened(config, max(channels) + 1)
        if card.microphone.problem:
            raise MicrophoneError(
                f"{card.microphone.name} is gone: {card.microphone.problem}. Disconnect its other microphones first."
            )
        if card.microphone.sample_rate != config.sample_rate:
            raise MicrophoneError(
                f"Microphones of one card ({name}) have sample_rate {card.microphone.sample_rate} and {config.sample_rate}: "
                "give them the same."
            )
        if config.channel >= card.microphone.channels:
            raise MicrophoneError(
                f"channel={config.channel} of a microphone ({name}): the card is open with {card.microphone.channels} "
                "channels. Make all of its microphones before one is connected."
            )
        card.n_users += 1
        return card


def leave_card(key: Hashable, card: OpenCard) -> None:
    """A microphone needs its card no longer; without any the card is closed."""
    with _lock:
        card.n_users -= 1
        if card.n_users == 0:
            _open_cards.pop(key, None)
            card.microphone.disconnect()


def _opened(config: "MicrophoneCameraConfig", channels: int) -> OpenCard:
    """A card that listens; with the microphone's own channel alone, if one that is not used any more wants too many.

    Raises:
        MicrophoneError: It cannot be opened, or nothing comes from it.
    """
    try:
        card = OpenCard(config, channels)
        card.open()
    except MicrophoneError:
        if channels == config.channel + 1:
            raise
        return _opened(config, config.channel + 1)
    return card
