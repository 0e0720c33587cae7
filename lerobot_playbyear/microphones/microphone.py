"""What every microphone is, whatever brings its sound; sound that is played as one; and those of other packages."""

import abc
import importlib
import logging
import threading
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_playbyear.audio.audio_files import AudioFileError, read_audio, resample
from lerobot_playbyear.datasets.errors import PlaybyearError

if TYPE_CHECKING:
    from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig

PLUGIN_PREFIX = "lerobot_microphone_"
"""What the name of a distribution begins with that brings sources of sound; its module has the same name."""

Listener = Callable[[np.ndarray, float], None]
"""Takes a chunk (n, channels), int16 PCM or floats in [-1, 1], and when its last sample came [s of time.perf_counter]."""

CHUNK_S = 0.003
"""How often sound is fetched from a card [s]; shorter costs more processor time."""

_TONE_S, _TONE_LEVEL = 1.0, 0.25


class MicrophoneError(PlaybyearError, RuntimeError):
    """A microphone cannot be opened, or is gone; the message says which, and what to do."""


class Microphone(abc.ABC):
    """A sound card that listens: all of its channels have one clock, and are read together.

    A subclass opens its device in `_open`, calls `_heard` from whatever thread brings samples, and closes it in `_close`.

    Args:
        name: For messages.
        sample_rate: Samples per second [Hz].
        channels: How many.

    Attributes:
        is_connected: Whether it was connected and not disconnected since.
        problem: Why no more sound comes, if that is certain; empty while all is well.
    """

    def __init__(self, name: str, sample_rate: int, channels: int) -> None:
        self.name, self.sample_rate, self.channels = name, sample_rate, channels
        self._listener: Listener | None = None
        self._last_heard = 0.0
        self.is_connected, self.problem = False, ""

    @property
    def silent_for_s(self) -> float:
        """Since when nothing has come [s]."""
        return time.perf_counter() - self._last_heard

    def connect(self, listener: Listener) -> None:
        """Begins to listen.

        Args:
            listener: Gets every chunk when it comes, in the device's thread, and copies what it keeps.

        Raises:
            MicrophoneError: It cannot be opened.
        """
        if self.is_connected:
            return
        self._listener, self.problem = listener, ""
        self._last_heard = time.perf_counter()
        self.is_connected = True  # before it may end by itself
        try:
            self._open()
        except BaseException:
            self.is_connected = False
            raise

    def disconnect(self) -> None:
        """Stops listening; it may be disconnected already."""
        if self.is_connected:
            self.is_connected = False
            self._close()

    @abc.abstractmethod
    def _open(self) -> None:
        """Opens the device.

        Raises:
            MicrophoneError: It cannot be opened.
        """

    @abc.abstractmethod
    def _close(self) -> None:
        """Closes it."""

    def _heard(self, chunk: np.ndarray, came_s: float) -> None:
        """Samples came, (n, channels); the last of them at `came_s` [s of time.perf_counter]."""
        self._last_heard = time.perf_counter()
        if self._listener is not None:
            self._listener(chunk, came_s)

    def _end(self, reason: str) -> None:
        """No more sound will come."""
        self.problem = self.problem or reason


class PlayedMicrophone(Microphone):
    """Gives samples again and again, at the speed of time.

    Args:
        name: For messages.
        samples: (n, channels) int16.
        sample_rate: [Hz].
    """

    def __init__(self, name: str, samples: np.ndarray, sample_rate: int) -> None:
        super().__init__(name, sample_rate, samples.shape[1])
        self._samples = samples
        self._stop = threading.Event()

    def _open(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._play, name="played sound", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _play(self) -> None:
        size = max(round(CHUNK_S * self.sample_rate), 1)
        n_played, start = 0, time.perf_counter()
        while True:
            due = start + (n_played + size) / self.sample_rate
            if self._stop.wait(max(due - time.perf_counter(), 0)):
                return
            self._heard(self._samples[np.arange(n_played, n_played + size) % len(self._samples)], due)
            n_played += size


def file_microphone(path: Path, sample_rate: int) -> Microphone:
    """A sound file, resampled where it has another rate [Hz].

    Raises:
        MicrophoneError: It cannot be read.
    """
    try:
        samples, rate = read_audio(path)
    except (OSError, AudioFileError) as error:
        raise MicrophoneError(f"file={path} of a microphone cannot be read: {error}") from error
    return PlayedMicrophone(f"the sound file {path}", resample(samples, rate, sample_rate), sample_rate)


def tone_microphone(tone_hz: float, sample_rate: int, channels: int) -> Microphone:
    """A sine of a quarter of full scale, the same on all channels; of whole periods in a second where `tone_hz` is whole."""
    time_s = np.arange(round(_TONE_S * sample_rate)) / sample_rate
    wave = np.rint(32767 * _TONE_LEVEL * np.sin(2 * np.pi * tone_hz * time_s)).astype(np.int16)
    return PlayedMicrophone(f"a tone of {tone_hz:g} Hz", np.repeat(wave[:, None], channels, axis=1), sample_rate)


Source = Callable[["MicrophoneCameraConfig", int], Microphone]
"""Makes a microphone, not connected yet, from a camera's options and how many channels it has at least."""

SOURCES: dict[str, Source] = {}


def register_source(name: str) -> Callable[[Source], Source]:
    """Registers what `--robot.cameras.<name>.source=NAME` makes, from a package named `lerobot_microphone_...`."""

    def register(source: Source) -> Source:
        SOURCES[name] = source
        return source

    return register


def find_source(name: str) -> Source:
    """A registered source.

    Raises:
        MicrophoneError: No installed package registers it.
    """
    if name not in SOURCES:
        for distribution in metadata.distributions():
            module = distribution.metadata.get("Name") or ""
            if module.startswith(PLUGIN_PREFIX):
                try:
                    importlib.import_module(module)
                except Exception:  # whatever is wrong with it, the others work
                    logging.exception("Could not import the microphones of %s", module)
    if name not in SOURCES:
        raise MicrophoneError(
            f"source={name!r} of a microphone is not registered; there is {', '.join(sorted(SOURCES)) or 'none'}. Install its "
            f"package, whose name begins with {PLUGIN_PREFIX}, or give `device`, `file` or `tone_hz` instead."
        )
    return SOURCES[name]


def make_microphone(config: "MicrophoneCameraConfig", channels: int) -> Microphone:
    """The card that a camera's options name, not connected yet, with at least as many channels.

    Raises:
        MicrophoneError: It is a file that cannot be read, or a source that nobody registers.
    """
    if config.source is not None:
        return find_source(config.source)(config, channels)
    if config.device is not None:
        from lerobot_playbyear.microphones.portaudio import PortAudioMicrophone

        return PortAudioMicrophone(config.device, config.sample_rate, channels)
    if config.tone_hz is not None:
        return tone_microphone(config.tone_hz, config.sample_rate, channels)
    return file_microphone(Path(str(config.file)).expanduser(), config.sample_rate)
