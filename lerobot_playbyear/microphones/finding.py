"""`playbyear-find-microphones`: which sound cards there are, what they take, and what they hear."""

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_playbyear.audio.audio_files import write_audio
from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.microphones.microphone import MicrophoneError
from lerobot_playbyear.microphones.portaudio import (
    PortAudioMicrophone,
    SoundCard,
    cards_called,
    channels_to_open,
    load_sounddevice,
    sound_cards,
)

_RATES = (8000, 16000, 32000, 44100, 48000, 96000)
_LIKED_RATES = (16000, 48000, 44100)  # the first that a card takes is suggested
_QUIETEST_DB, _BAR = -60, 20
_LOOK_S, _PATIENCE_S = 0.1, 3.0
_CLIPPED = 32700
_NO_CARD = (
    "There is no sound card with an input. Plug a microphone in. On Linux `arecord -l` lists what the system sees, and you "
    "must be in the group audio. In a container pass --device=/dev/snd, or the socket of PulseAudio or PipeWire."
)


@dataclass
class FindMicrophonesConfig:
    """Options of `playbyear-find-microphones`.

    Args:
        list: List the microphones without listening.
        seconds: How long to listen to each microphone [s].
        output_dir: Folder of the WAV files, one per microphone.
    """

    list: bool = False
    seconds: float = 3.0
    output_dir: Path = Path("outputs/microphones")


def find_microphones(cfg: FindMicrophonesConfig) -> None:
    """Prints what there is, and unless told otherwise listens to each card in turn.

    Raises:
        InputError: An option is out of range.
        MicrophoneError: There is no card, or nothing can be heard with any.
    """
    if not 0.1 <= cfg.seconds <= 60:
        raise InputError(f"seconds={cfg.seconds}: give seconds from 0.1 to 60.")
    cards = sound_cards(fresh=True)
    if not cards:
        raise MicrophoneError(_NO_CARD)
    n_heard = 0
    for card in cards:
        rates = accepted_rates(card)
        print(printable("\n".join(described(card, rates, cards))), flush=True)
        if not cfg.list:
            try:
                print(f"  {_listen(card, suggested_rate(card, rates), cfg)}\n", flush=True)
                n_heard += 1
            except MicrophoneError as error:
                print(f"  {printable(error)}\n", flush=True)
    if not cfg.list and n_heard == 0:
        raise MicrophoneError("None of these sound cards can be opened. Close other programs that use them.")


def accepted_rates(card: SoundCard) -> tuple[int, ...]:
    """The usual sample rates that a card takes [Hz]; a sound server takes all, and resamples."""
    sounddevice = load_sounddevice()

    def takes(rate: int) -> bool:
        try:
            sounddevice.check_input_settings(card.number, channels_to_open(card, 1), "int16", samplerate=rate)
        except Exception:  # PortAudio's errors are its answer
            return False
        return True

    with _without_stderr():
        return tuple(rate for rate in _RATES if takes(rate))


def suggested_rate(card: SoundCard, rates: tuple[int, ...]) -> int:
    """The rate to record with [Hz]."""
    return next((rate for rate in _LIKED_RATES if rate in rates), card.sample_rate)


def suggested_device(card: SoundCard, cards: list[SoundCard]) -> tuple[str, bool]:
    """What chooses a card among all, and whether it still does so when they were plugged in in another order."""
    for name in (card.lasting_name, card.name):
        if cards_called(name, cards) == [card]:
            return name, name == card.lasting_name
    return str(card.number), False


def described(card: SoundCard, rates: tuple[int, ...], cards: list[SoundCard]) -> Iterator[str]:
    """One card of all, line by line, with the option that chooses it."""
    yield f"{card.number}: {card.name}{' (default)' if card.is_default else ''}"
    served = "" if channels_to_open(card, 1) == card.channels else ", as a sound server says; the card itself has fewer"
    yield f"  channels: {card.channels}{served}"
    yield f"  sample rates: {', '.join(map(str, rates)) or 'none that is usual'} Hz; its own is {card.sample_rate} Hz"
    device, is_lasting = suggested_device(card, cards)
    rate = suggested_rate(card, rates)
    quoted = device.replace("\\", "\\\\").replace('"', '\\"').replace("'", "'\\''")  # for YAML, then for a shell
    yield f"  --robot.cameras='{{mic: {{type: microphone, device: \"{quoted}\", sample_rate: {rate}}}}}'"
    if not is_lasting:
        yield (
            "  Another card has the same name. They cannot be told apart, and may swap after a restart or another order of "
            "plugging: take one card with two channels, or cards of two kinds."
        )


def level_text(samples: np.ndarray) -> str:
    """How loud each channel is: (n, channels) int16 as bars from -60 dB to full scale."""
    texts = []
    for number, channel in enumerate(samples.T.astype(np.float64)):
        loudest = float(np.abs(channel).max(initial=0))
        level = max(20 * np.log10(loudest / 32768), _QUIETEST_DB) if loudest else _QUIETEST_DB
        bar = "#" * round(_BAR * (level - _QUIETEST_DB) / -_QUIETEST_DB)
        said = "clips" if loudest >= _CLIPPED else f"{level:.0f} dB" if loudest else "zeros"
        texts.append(f"{number} [{bar:<{_BAR}}] {said:>6}")
    return "  ".join(texts)


def _listen(card: SoundCard, rate: int, cfg: FindMicrophonesConfig) -> str:
    """Listens to a card, shows its level meanwhile, writes a file, and says what was heard."""
    channels = channels_to_open(card, 1)
    microphone = PortAudioMicrophone(card.number, rate, channels)
    samples = _heard(microphone, cfg.seconds)
    if len(samples) == 0 and not microphone.problem:
        # Through a sound server a stream that was opened now and then never begins.
        samples = _heard(microphone, cfg.seconds)
    if sys.stdout.isatty():
        print("\r\033[K", end="")
    if len(samples) == 0:
        raise MicrophoneError(microphone.problem or "nothing came from it")
    path = write_audio(cfg.output_dir / f"microphone_{card.number}.wav", samples, rate)
    silent = "" if samples.any() else "; nothing but zeros: is it muted?"
    return f"loudest: {level_text(samples)}{silent}\n  {path}"


def _heard(microphone: PortAudioMicrophone, seconds: float) -> np.ndarray:
    """What it hears in so many seconds from its first sample on, (n, channels) int16; its level is shown meanwhile."""
    parts, wanted = [np.zeros((0, microphone.channels), np.int16)], round(seconds * microphone.sample_rate)
    with _without_stderr():
        microphone.connect(lambda chunk, came_s: parts.append(chunk.copy()))
    end = time.perf_counter() + seconds + _PATIENCE_S
    try:
        while sum(map(len, parts)) < wanted and time.perf_counter() < end and not microphone.problem:
            n_shown = len(parts)
            time.sleep(_LOOK_S)
            if sys.stdout.isatty() and parts[n_shown:]:
                print(f"\r  {level_text(np.concatenate(parts[n_shown:]))}", end="", flush=True)
    finally:
        microphone.disconnect()
    return np.concatenate(parts)[:wanted]


@contextlib.contextmanager
def _without_stderr() -> Iterator[None]:
    """PortAudio and ALSA print to it what they then return as errors."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)
