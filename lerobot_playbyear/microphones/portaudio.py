"""Sound cards through PortAudio."""

import contextlib
import time
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from lerobot_playbyear.compat import look_for_cards_again
from lerobot_playbyear.microphones.microphone import CHUNK_S, Microphone, MicrophoneError

_FIND = "`playbyear-find-microphones` lists what there is."
_MOST_OPENED = 8  # channels of a card that are opened without being asked for; a sound server offers 32, and has fewer


@dataclass(frozen=True)
class SoundCard:
    """A sound card with inputs, as PortAudio sees it.

    Args:
        number: PortAudio's; it may change when something is plugged in.
        name: With the name of the sound system.
        channels: Inputs.
        sample_rate: The one that it prefers [Hz].
        is_default: Whether programs that do not ask get it.
    """

    number: int
    name: str
    channels: int
    sample_rate: int
    is_default: bool

    @property
    def lasting_name(self) -> str:
        """The name without ALSA's number, such as " (hw:1,0), ALSA", which changes with the order of plugging."""
        return self.name.partition(" (hw:")[0]


def load_sounddevice() -> ModuleType:
    """The package `sounddevice`.

    Raises:
        MicrophoneError: It, or PortAudio, is not installed.
    """
    try:
        import sounddevice  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError as error:
        raise MicrophoneError("Microphones need the package sounddevice: pip install sounddevice.") from error
    except OSError as error:
        raise MicrophoneError(f"PortAudio is missing ({error}). Debian: sudo apt install libportaudio2.") from error
    return sounddevice


def sound_cards(fresh: bool = False) -> list[SoundCard]:
    """All cards with inputs.

    Args:
        fresh: Whether to look for what was plugged in since the first look. No stream may be open then.

    Raises:
        MicrophoneError: `sounddevice` or PortAudio is not installed, or does not start.
    """
    sounddevice = load_sounddevice()
    try:
        if fresh:
            look_for_cards_again(sounddevice)
        systems = sounddevice.query_hostapis()
        default = sounddevice.default.device[0]
        return [
            SoundCard(
                number,
                f"{device['name']}, {systems[device['hostapi']]['name']}",
                int(device["max_input_channels"]),
                round(device["default_samplerate"]),
                number == default,
            )
            for number, device in enumerate(sounddevice.query_devices())
            if device["max_input_channels"] > 0
        ]
    except sounddevice.PortAudioError as error:
        raise MicrophoneError(f"PortAudio does not start: {error}.") from error


def cards_called(text: str, cards: list[SoundCard]) -> list[SoundCard]:
    """Those cards of which a text is the number, or the name, whole or without the sound system; otherwise a part of it."""
    if text.isdecimal():
        return [card for card in cards if card.number == int(text)]
    exact = [card for card in cards if text in (card.name, card.name.rpartition(", ")[0], card.lasting_name)]
    return exact or [card for card in cards if text.lower() in card.name.lower()]


def find_card(wanted: str | int, channels: int) -> SoundCard:
    """The card that is asked for, and never another one.

    Args:
        wanted: Its number, its name, or a part of its name that no other card has.
        channels: How many it needs.

    Raises:
        MicrophoneError: There is none, or more than one, or it has fewer channels.
    """
    cards = sound_cards()
    listed = "; ".join(f"{card.number}: {card.name}" for card in cards) or "none"
    text = str(wanted).strip()
    found = cards_called(text, cards) if text else []
    if len(found) != 1:
        what = "is not a sound card with an input" if not found else "fits more than one sound card"
        raise MicrophoneError(f"device={text!r} {what}. There are: {listed}. {_FIND}")
    (card,) = found
    if card.channels < channels:
        raise MicrophoneError(
            f"device={text!r}: channel {channels - 1} is asked for, counted from 0, and {card.name} has "
            f"{card.channels}. {_FIND}"
        )
    return card


def channels_to_open(card: SoundCard, needed: int) -> int:
    """How many channels of a card to open, at least `needed`, so that each is its own.

    A sound server that is asked for fewer than a card has mixes them: its mono is the mean of left and right. What it offers
    is no help, 32 whatever the card has. So two are opened there unless more are needed.
    """
    return card.channels if card.channels <= _MOST_OPENED else max(needed, 2)


_open_streams: set[Any] = set()


class PortAudioMicrophone(Microphone):
    """A sound card of this machine.

    Args:
        device: Its name, a part of it that no other has, or its number.
        sample_rate: [Hz].
        channels: How many it gives, at least.
    """

    def __init__(self, device: str | int, sample_rate: int, channels: int) -> None:
        super().__init__(f"the microphone {str(device)!r}", sample_rate, channels)
        self._device = device

    def _open(self) -> None:
        """PortAudio knows the cards that were there when it looked; where none of these can be opened, it looks again."""
        card: SoundCard | None = None
        try:
            card = find_card(self._device, self.channels)
            self._open_card(card)
        except MicrophoneError as error:
            if _open_streams:  # PortAudio would close them
                raise
            sound_cards(fresh=True)
            try:
                self._open_card(find_card(self._device, self.channels))
            except MicrophoneError:
                if card is not None:  # it was there, and why it cannot be opened says more
                    raise error from None
                raise

    def _open_card(self, card: SoundCard) -> None:
        sounddevice = load_sounddevice()
        channels, stream = channels_to_open(card, self.channels), None
        try:
            stream = sounddevice.InputStream(
                samplerate=self.sample_rate,
                blocksize=max(round(CHUNK_S * self.sample_rate), 1),
                device=card.number,
                channels=channels,
                dtype="int16",
                latency="low",
                callback=self._take,
                finished_callback=self._finished,
            )
            stream.start()
        except Exception as error:  # PortAudio's errors, and those of its arguments
            if stream is not None:
                stream.close(ignore_errors=True)
            said = str(error).replace("\n", " ")
            raise MicrophoneError(
                f"{card.name} cannot be opened with {channels} channels at {self.sample_rate} Hz: {said}. Is it plugged in, "
                "and its sound server running? Close other programs that use it, or give another sample_rate: its own is "
                f"{card.sample_rate} Hz."
            ) from error
        self._stream = stream
        _open_streams.add(stream)

    def _close(self) -> None:
        _open_streams.discard(self._stream)
        with contextlib.suppress(Exception):  # of a card that is gone
            self._stream.abort(ignore_errors=True)
            self._stream.close(ignore_errors=True)

    def _take(self, chunk: np.ndarray, n: int, when: Any, status: Any) -> None:
        # PortAudio's own times are estimates that may be too early, and on ALSA they may stand at 0.
        self._heard(chunk[:, : self.channels], time.perf_counter())

    def _finished(self) -> None:
        if self.is_connected:
            self._end("the sound card, or its sound server, has ended the recording")
