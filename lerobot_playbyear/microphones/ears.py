"""All microphones of a robot: opened card by card, heard tick by tick, watched for what goes wrong."""

from collections.abc import Hashable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields

import numpy as np

from lerobot_playbyear.datasets.microphone import DropOut
from lerobot_playbyear.microphones.card import CardRecording
from lerobot_playbyear.microphones.config import MicrophoneConfig
from lerobot_playbyear.microphones.microphone import Microphone, MicrophoneError, wait_for_first_sound


@dataclass
class _Card:
    microphone: Microphone
    recording: CardRecording
    latency_s: float

    def open(self) -> None:
        """
        Raises:
            MicrophoneError: It cannot be opened.
        """
        if not self.microphone.is_connected:
            self.recording.forget()
            self.microphone.connect(self.recording.write)


class Ears:
    """The microphones of a robot.

    Args:
        configs: By their names.
        fps: Ticks per second [Hz].
        stalled_s: A card that brings nothing for as long is taken for dead [s].
        silent_s: A microphone that gives nothing but zeros for as long is taken for unplugged [s]; 0: never.

    Raises:
        ValueError: The rate of ticks does not divide a sample rate.
        MicrophoneError: Options of two microphones on one card differ.
    """

    def __init__(
        self, configs: Mapping[str, MicrophoneConfig], fps: int, stalled_s: float = 1.0, silent_s: float = 2.0
    ) -> None:
        by_card: dict[Hashable, dict[str, MicrophoneConfig]] = {}
        for name, config in configs.items():
            by_card.setdefault(config.card, {})[name] = config
        self._stalled_s, self._silent_s = stalled_s, silent_s
        self._names = list(configs)
        self._cards = [_make_card(microphones, fps) for microphones in by_card.values()]

    def connect(self) -> None:
        """Opens all cards that are not open, and waits for their first sound.

        Raises:
            MicrophoneError: One cannot be opened, or nothing comes from it. Then none is open.
        """
        with ExitStack() as stack:
            stack.callback(self.disconnect)
            for card in self._cards:
                if self._problem_of(card):
                    card.microphone.disconnect()
            self._open()
            for card in self._cards:
                wait_for_first_sound(card.microphone, card.recording.write, card.recording.wait_for_sound)
            stack.pop_all()

    def _open(self) -> None:
        """Opens all cards that are not open.

        PortAudio looks for what was plugged in only while none of its cards is open. So where one cannot be opened beside
        others, all are closed, and that one comes first.
        """
        for card in self._cards:
            try:
                card.open()
            except MicrophoneError:
                if not any(other.microphone.is_connected for other in self._cards):
                    raise
                self.disconnect()
                for again in [card, *self._cards]:
                    again.open()
                return

    def restart(self, now_s: float) -> None:
        """An episode begins at `now_s` [s of time.perf_counter]."""
        for card in self._cards:
            card.recording.restart(now_s + card.latency_s)

    def skip_to(self, now_s: float) -> None:
        """What was heard until `now_s` belongs to no frame."""
        for card in self._cards:
            card.recording.skip_to(now_s + card.latency_s)

    def read(self, until_s: float) -> dict[str, np.ndarray]:
        """For each microphone (S,) int16: what happened near it up to `until_s`, since the block before.

        Waits for as long as sound needs to come, at most a tenth of a second more.
        """
        blocks: dict[str, np.ndarray] = {}
        for card in self._cards:
            blocks |= card.recording.read(until_s + card.latency_s)
        return {name: blocks[name] for name in self._names}

    @property
    def drop_outs(self) -> dict[str, list[DropOut]]:
        """Of each microphone, since the episode began."""
        return {name: list(card.recording.drop_outs) for card in self._cards for name in card.recording.channels}

    @property
    def latency_s(self) -> float:
        """Of the slowest [s]."""
        return max((card.latency_s for card in self._cards), default=0.0)

    @property
    def patience_s(self) -> float:
        """How long `read` waits at most for sound that does not come, after a first block has come [s]."""
        return self.latency_s + sum(card.recording.timeout_s for card in self._cards)

    @property
    def problem(self) -> str:
        """What is wrong, if no more sound comes; empty while all is well."""
        return next(filter(None, map(self._problem_of, self._cards)), "")

    def _problem_of(self, card: _Card) -> str:
        microphone, names = card.microphone, ", ".join(card.recording.channels)
        if microphone.problem:
            return f"The microphone {names} is gone: {microphone.problem}."
        if microphone.silent_for_s > self._stalled_s:
            return f"The microphone {names} has brought nothing for {microphone.silent_for_s:.1f} s."
        zeros_s = {name: for_s for name, for_s in card.recording.zeros_s.items() if for_s > self._silent_s > 0}
        if zeros_s:
            return (
                f"The microphone {', '.join(zeros_s)} has given nothing but zeros for {max(zeros_s.values()):.1f} s: it is "
                "muted, or unplugged."
            )
        return ""

    def disconnect(self) -> None:
        """Closes all cards."""
        for card in self._cards:
            card.microphone.disconnect()


def _make_card(microphones: Mapping[str, MicrophoneConfig], fps: int) -> _Card:
    (first_name, first), *others = microphones.items()
    for name, config in others:
        for option in (field.name for field in fields(config) if field.name != "channel"):
            values = [str(getattr(each, option, None)) for each in (first, config)]  # device: 2 is the same as "2"
            if values[0] != values[1]:
                raise MicrophoneError(
                    f"The microphones {first_name} and {name} are channels of one card, and have {option}={values[0]} and "
                    f"{values[1]}: give them the same."
                )
    channels = {name: config.channel for name, config in microphones.items()}
    recording = CardRecording(first.sample_rate, fps, channels)
    return _Card(first.make(max(channels.values()) + 1), recording, first.latency_s)
