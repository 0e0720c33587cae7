"""A microphone as a LeRobot camera: `--robot.cameras='{mic: {type: microphone, device: "USB Audio"}}'`.

Its picture shows the spectrogram of the last two seconds, and carries the exact samples and their number (see
`audio.microphone_pictures`).
"""

import logging
import secrets
import threading
import time
import weakref
from collections.abc import Hashable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from draccus.utils import DecodingError
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_playbyear.audio.microphone_pictures import (
    SESSIONS,
    TIMECODE_HEIGHT,
    TIMECODE_WIDTH,
    Strip,
    n_kept,
    n_rows,
    session_path,
    write_strip,
    write_timecode,
)
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.microphones.card import KEPT_S, CardRecording, OpenCard, join_card, leave_card
from lerobot_playbyear.microphones.microphone import MicrophoneError
from lerobot_playbyear.microphones.session_file import SessionFile

_NO_FILE = "none"
_LARGEST = 1024  # pixels, a side; a larger picture takes longer than a control step has
_STALLED_S = 1.0  # without sound: gone, and not only late on a busy machine
_ZEROS_S = 2.0  # of nothing but zeros: muted, or unplugged
_FIND = "`playbyear-find-microphones` prints an entry to paste."


class MicrophoneOptionError(PlaybyearError, DecodingError):
    """An option of a microphone has no meaning. Being draccus' own as well, LeRobot's commands say it in one line."""

    def __init__(self, message: str) -> None:
        DecodingError.__init__(self, (), message)


@CameraConfig.register_subclass("microphone")
@dataclass(kw_only=True)
class MicrophoneCameraConfig(CameraConfig):
    """A microphone among `--robot.cameras`. Give one of `device`, `file`, `tone_hz` and `source`.

    Args:
        device: Name of a sound card, a unique part of it, or its number. `playbyear-find-microphones` lists them.
        file: A sound file that is played in real time, over and over.
        tone_hz: A tone instead of sound [Hz].
        source: Name of a source that another package registers. `device` is then for that source.
        sample_rate: Samples per second [Hz].
        channel: Channel of the card, counted from 0. Microphones of one card share its stream and its clock.
        gain_db: Gain on the samples [dB]. Louder samples than full scale are clipped.
        save_to: Folder for the session's sound. None: `playbyear_sessions` in LeRobot's home. "none": it is not saved.
        low_db, high_db: Levels shown as black and white in the spectrogram [dB; a sine at full scale has 0].
        width, height: Size of the picture [pixels].
        fps: As for other cameras. The picture is drawn whenever it is read.

    Raises:
        MicrophoneOptionError: An option is out of range.
    """

    device: str | int | None = None
    file: str | None = None
    tone_hz: float | None = None
    source: str | None = None
    sample_rate: int = 16000
    channel: int = 0
    gain_db: float = 0.0
    save_to: str | None = None
    low_db: float = -90.0
    high_db: float = -20.0
    width: int | None = 224
    height: int | None = 224
    fps: int | None = 30

    def __post_init__(self) -> None:
        given = [name for name in ("device", "file", "tone_hz") if getattr(self, name) not in (None, "")]
        if self.source is None and len(given) != 1:
            seen = " and ".join(given) or "nothing"
            raise MicrophoneOptionError(f"A microphone has {seen}: give one of device, file and tone_hz. {_FIND}")
        tone = self.tone_hz
        for name, wanted, is_good in (
            ("sample_rate", "Hz from 1000 to 384000", 1000 <= self.sample_rate <= 384_000),
            ("channel", "the card's channel, counted from 0", 0 <= self.channel < 256),
            ("gain_db", "dB from -60 to 60", -60 <= self.gain_db <= 60),
            ("tone_hz", "Hz below half the sample_rate", tone is None or 0 < tone < self.sample_rate / 2),
            ("low_db", f"at least -100, and below high_db={self.high_db}", -100 <= self.low_db < self.high_db <= 20),
        ):
            if not is_good:
                raise MicrophoneOptionError(f"{name}={getattr(self, name)} of a microphone: give {wanted}.")
        width, height = self.width or 0, self.height or 0
        needed = TIMECODE_HEIGHT + n_rows(self.sample_rate, max(width, TIMECODE_WIDTH))
        if width < TIMECODE_WIDTH or height < needed or width % 2 or height % 2 or max(width, height) > _LARGEST:
            raise MicrophoneOptionError(
                f"width={width} and height={height} of a microphone: its samples and its timecode need at least "
                f"width={TIMECODE_WIDTH} and at this width height={needed + needed % 2}, both even, at most {_LARGEST}."
            )

    @property
    def card(self) -> Hashable:
        """What tells cards apart: microphones with the same one share a stream and a clock."""
        return self.source, str(self.device), self.file, self.tone_hz

    @property
    def label(self) -> str:
        """Which microphone it is, for messages."""
        options = {name: getattr(self, name) for name in ("source", "device", "file", "tone_hz")}
        return ", ".join(f"{name}={value!r}" for name, value in options.items() if value is not None)


_cameras: "weakref.WeakSet[MicrophoneCamera]" = weakref.WeakSet()
"""All that were made: the first of a card that is connected opens the channels of all of them."""


def _heard(config: MicrophoneCameraConfig, recording: CardRecording, start: int, stop: int) -> np.ndarray:
    """A microphone's samples from one number to before another, (n,) int16, with its gain."""
    samples = recording.samples(start, stop)[:, config.channel]
    gain = 10 ** (config.gain_db / 20)
    return samples if gain == 1 else np.clip(np.rint(samples * gain), -32768, 32767).astype(np.int16)


class MicrophoneCamera(Camera):
    """A microphone that LeRobot reads at every control step.

    Args:
        config: Its options.
    """

    def __init__(self, config: MicrophoneCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._card: OpenCard | None = None
        self._file: SessionFile | None = None
        self._session = 0
        self._reading = threading.Lock()
        self._was_mute = False
        _cameras.add(self)

    def __str__(self) -> str:
        return f"The microphone ({self.config.label})"

    @property
    def is_connected(self) -> bool:
        return self._card is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """None: `playbyear-find-microphones` looks for sound cards."""
        return []

    def connect(self, warmup: bool = True) -> None:
        """Begins to listen, and to write the session's sound.

        Raises:
            DeviceAlreadyConnectedError: It listens already.
            MicrophoneError: It cannot be opened, nothing comes from it, or its sound cannot be written.
        """
        from lerobot_playbyear.audio.sound_picture import RollingSpectrogram

        if self._card is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        config, width, height = self.config, self.width or 0, self.height or 0
        rows = n_rows(config.sample_rate, width)
        self._spectrogram = RollingSpectrogram(config.sample_rate, height - rows, width, config.low_db, config.high_db)
        self._session = 1 + secrets.randbelow(2**32 - 1)
        _cameras.add(self)
        try:
            alike = [camera.config.channel for camera in _cameras if camera.config.card == config.card]
            self._card = join_card(config, alike)
        except BaseException:
            _cameras.discard(self)  # others of the card need not have its channel
            raise
        self._samples = partial(_heard, config, self._card.recording)
        try:
            self._file = self._session_file(self._card)
        except (OSError, ValueError) as error:
            self.disconnect()
            raise MicrophoneError(
                f"The session's sound cannot be written to {config.save_to or SESSIONS}: {error}. Give another save_to, or "
                "save_to=none."
            ) from error

    def _session_file(self, card: OpenCard) -> SessionFile | None:
        config = self.config
        if config.save_to == _NO_FILE:
            logging.warning(
                "%s saves no sound (save_to=none): a dataset with videos loses it, one with --dataset.video=false keeps "
                "it in its pictures.",
                str(self),
            )
            return None
        folder = Path(config.save_to).expanduser() if config.save_to else SESSIONS
        path = session_path(folder, self._session, time.strftime("%Y-%m-%d_%H-%M-%S"))
        recording, n_kept = card.recording, round(KEPT_S * config.sample_rate)  # no `self`: once forgotten, it ends
        file = SessionFile(path, config.sample_rate, lambda: recording.written, self._samples, n_kept)
        logging.info(
            "%s listens. Everything that it hears, voices included, is written to %s (%.1f MB a minute). Its pictures hold "
            "the sound, too.",
            str(self),  # a record of the log may be kept
            path,
            120 * config.sample_rate / 1e6,
        )
        return file

    def read(self) -> np.ndarray:
        """The picture of now, (height, width, 3) uint8. Raises as `read_latest`."""
        return self.read_latest()

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The picture of now, (height, width, 3) uint8. Raises as `read_latest`."""
        return self.read_latest()

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """The picture of now, (height, width, 3) uint8.

        Raises:
            DeviceNotConnectedError: It was not connected, it is gone, or its sound can no longer be saved.
            TimeoutError: No sound has come for a second, or for `max_age_ms` [ms] if that is longer.
        """
        card = self._card
        if card is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        if card.microphone.problem:
            raise DeviceNotConnectedError(f"{self} is gone: {card.microphone.problem}.")
        silent_s = card.microphone.silent_for_s
        if silent_s > max(max_age_ms / 1000, _STALLED_S):
            raise TimeoutError(f"{self} has given no sound for {silent_s:.1f} s. Is it still plugged in?")
        if self._file is not None and self._file.error:
            raise DeviceNotConnectedError(f"{self}: {self._file.error}. Make room, and begin again.")
        is_mute = card.recording.zeros_s(self.config.channel) > _ZEROS_S
        if is_mute and not self._was_mute:
            logging.warning("%s gives nothing but zeros: it is muted, or unplugged.", str(self))
        self._was_mute = is_mute
        with self._reading:
            return self._picture(card.newest(self._session))

    def _picture(self, counter: int) -> np.ndarray:
        config = self.config
        grey = self._spectrogram.draw(counter, self._samples)
        picture = np.zeros((self.height or 0, self.width or 0, 3), np.uint8)
        picture[: len(grey)] = grey[:, :, None]
        kept = self._samples(counter - n_kept(config.sample_rate), counter)
        write_strip(picture, Strip(self._session, counter, config.sample_rate, kept, config.low_db, config.high_db))
        write_timecode(picture, self._session, counter)
        return picture

    def disconnect(self) -> None:
        """Stops listening, and says where the session's sound is.

        Raises:
            DeviceNotConnectedError: It was not connected.
        """
        if self._card is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        file, self._file = self._file, None
        if file is not None:
            file.close()
            logging.info("The session's sound is in %s%s.", file.path, ", not to its end" if file.error else "")
        card, self._card = self._card, None
        leave_card(self.config, card)
