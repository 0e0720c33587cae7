"""What training does to sound, so that the policy bears other rooms and other microphones: each microphone's own noise, the
noise of a room with people in it, which reaches all microphones, and another frequency response of each."""

import logging
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from lerobot_playbyear.audio.audio_files import AudioFileError, audio_pieces, resample
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.generated_noise import Draw, GeneratedNoise, faded, rooms

_FAINTEST_DB = -20.0  # of a microphone's own noise, relative to an item's noise floor
_NOISE_TILT = (0.0, 1.2)  # exponent of 1 / frequency: from white to a little steeper than pink
_NOISE_LOWEST_HZ = 20.0  # below it noise grows no further
_HUM_HZ = (45.0, 75.0)
_HUM_HARMONICS = 4
_HUM_DB = (-20.0, 0.0)  # relative to the broadband noise
_ROOM_SHARE = 0.75  # of the items that hear a room with people in it
_RECORDED_SHARE = 0.5  # of those, if there are recordings: the others hear what is generated
_ROOM_DB = -6.0  # of the faintest relative to an item's noise floor, and of the loudest to `audio_noise_db`
_FARTHER_DB = 6.0  # at most, from the microphone that hears it best to another one
_ENDINGS = (".wav", ".flac")  # of files with recorded noise
_MOST_SECONDS = 7200  # of all recordings
_SILENCE = 1e-5  # root mean square
_LEAKAGE = 8  # bins above the highest one that is kept, whose noise still reaches it
_COLOUR_POINTS = 6  # of a microphone's response, evenly spaced in octaves
_COLOUR_DB = 4.0  # standard deviation of its gain at them

logger = logging.getLogger(__name__)


class SoundAugmentation(nn.Module):
    """Noise and other microphones' responses, drawn for every item; nothing of it is in a checkpoint.

    In comments: B items, M microphones, n samples, bins: frequencies of an item's spectrum that the policy hears.
    """

    response: Tensor

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        assert config.sample_rate is not None
        self.sample_rate, self.max_db = config.sample_rate, config.audio_noise_db
        self.files, self.has_generated = config.audio_noise_files, config.audio_room_noise
        self.has_reference = config.reference_key is not None
        self.highest_hz = (config.n_frequency_bins + _LEAKAGE) / config.segment_s
        self.generated = GeneratedNoise()
        self._recorded: RecordedNoise | None = None
        octaves = torch.log2(torch.arange(1, config.n_frequency_bins + 1).float())
        place = octaves / octaves.max().clamp(min=1e-6) * (_COLOUR_POINTS - 1)  # of a bin, in points
        away = (place[:, None] - torch.arange(_COLOUR_POINTS)).abs()
        self.register_buffer("response", (1 - away).clamp(min=0), persistent=False)  # (bins, points)

    def read_recordings(self) -> None:
        """Reads the folder of recorded noise, if there is one and that was not done; learning does it at the latest.

        Raises:
            InputError: The folder cannot be used.
        """
        if self.files is not None and self._recorded is None:
            self._recorded = RecordedNoise(self.files, self.sample_rate)

    def forward(self, waves: Tensor) -> tuple[Tensor, Tensor | None]:
        """What microphones hear, (B, M, n) in [-1, 1], with noise; and in rooms other microphones' gains, of `colour`.

        Raises:
            InputError: The folder of recorded noise cannot be used.
        """
        if self.max_db is None:
            return waves, None
        self.read_recordings()
        n_items, n_microphones, n = waves.shape
        n_bins = min(n // 2, math.ceil(min(self.highest_hz, self.sample_rate) * n / self.sample_rate))
        size = (self.max_db, n_items, n_microphones, n, n_bins)
        is_in_a_room = self.has_generated or self._recorded is not None
        # Without autocast, in whose format noise hides what is 50 dB below it.
        with torch.autocast(waves.device.type, enabled=False):
            spectrum = self._own(*size) + self._of_the_room(*size) if is_in_a_room else self._own(*size)
            noise = torch.fft.irfft(functional.pad(spectrum, (1, n // 2 - n_bins)), n=n, norm="forward")
            return waves + noise_floor(waves) * noise, self.colour(n_items, n_microphones) if is_in_a_room else None

    def colour(self, n_items: int, n_microphones: int) -> Tensor:
        """A microphone's gain in every bin of the spectrogram, a smooth curve, (B, M, bins) [10 dB]."""
        n_drawn = 1 if self.has_reference else n_microphones  # what differs between two is in their means
        points = torch.randn(n_items, n_drawn, _COLOUR_POINTS, device=self.response.device)
        return (_COLOUR_DB / 10 * points @ self.response.T).expand(-1, n_microphones, -1)

    def _own(self, max_db: float, n_items: int, n_microphones: int, n: int, n_bins: int) -> Tensor:
        """The spectrum of each microphone's own noise, (B, M, bins) complex, in units of its floor: broadband, with a hum.

        White noise alone teaches nothing about rooms, whose noise is louder the lower it is. Drawn per item and microphone,
        evenly: the level, between 20 dB below the floor and `audio_noise_db` above it; the tilt, power falling as frequency to
        the power 0 to 1.2; the hum's pitch, 45 to 75 Hz with three overtones; and its level, from 20 dB below the broadband
        noise to as loud. Levels are those of all frequencies, also of those that the policy does not hear.
        """
        device = self.response.device
        n_drawn = 1 if self.has_reference else n_microphones  # a room's background is as loud at both
        draws = torch.rand(4, n_items, n_drawn, 1, device=device).expand(-1, -1, n_microphones, -1)
        ranges = zip(((_FAINTEST_DB, max_db), _NOISE_TILT, _HUM_HZ, _HUM_DB), draws, strict=True)
        level, tilt, pitch, hum = (low + (high - low) * draw for (low, high), draw in ranges)
        resolution = self.sample_rate / n  # [Hz] of a bin
        frequency = resolution * torch.arange(1, n_bins + 1, device=device)
        power = frequency.clamp(min=_NOISE_LOWEST_HZ) ** -tilt  # (B, M, bins)
        power = power * (resolution / _power_below(self.sample_rate / 2, tilt))
        overtones = torch.arange(1, _HUM_HARMONICS + 1, device=device)
        bins = (pitch * overtones / resolution).round().long().clamp(1, n_bins) - 1  # (B, M, harmonics)
        harmonic = (10 ** (hum / 10) / _HUM_HARMONICS).expand(-1, -1, _HUM_HARMONICS)
        power = power.scatter_add(2, bins, harmonic)
        amplitude = 10 ** (level / 20) * power.sqrt() / 2  # as of both signs of a frequency
        return torch.view_as_complex(torch.randn(*power.shape, 2, device=device) * amplitude.unsqueeze(3))

    def _of_the_room(self, max_db: float, n_items: int, n_microphones: int, n: int, n_bins: int) -> Tensor:
        """The spectrum of what goes on in a room, (B, M, bins) complex, in units of each microphone's floor.

        One source reaches all microphones of an item, each by its own way through the room. Three quarters of the items hear
        one, of any kind and from any moment on. Its level is drawn evenly, from 6 dB below the floor to 6 dB below
        `audio_noise_db`: of louder noise a policy learns to guess.
        """
        device, seconds = self.response.device, n / self.sample_rate
        draw = Draw(device)
        sources = self.generated(seconds, n_bins, n_items) if self.has_generated else None  # (B, bins)
        if self._recorded is not None:
            excerpts = faded(self._recorded.excerpts(n_items, n).to(device), self.sample_rate)
            spectra = torch.fft.rfft(excerpts, norm="forward")[:, 1 : n_bins + 1]
            is_recorded = draw.even(0, 1, n_items, 1) < _RECORDED_SHARE
            sources = spectra if sources is None else torch.where(is_recorded, spectra, sources)
        assert sources is not None
        ways = rooms(n_microphones, seconds, n_bins, device)  # (rooms, M, bins)
        ways = ways[draw.whole(len(ways), n_items)]
        moment = draw.whole(n, n_items, 1)
        turns = moment * torch.arange(1, n_bins + 1, device=device) % n  # as integers: floats would lose the fraction
        angle = 2 * math.pi / n * turns
        shifted = sources * torch.complex(angle.cos(), angle.sin())
        level = _ROOM_DB + draw.even(min(0.0, max_db), max_db, n_items, 1, 1)  # [dB]
        farther = draw.even(0, _FARTHER_DB, n_items, n_microphones, 1)
        level = level - farther + farther.amin(dim=1, keepdim=True)
        gain = 10 ** (level / 20) * (draw.even(0, 1, n_items, 1, 1) < _ROOM_SHARE)
        return gain * ways * shifted.unsqueeze(1)


def _power_below(highest_hz: float, tilt: Tensor) -> Tensor:
    """Integral of the noise's power over frequency, in its own units."""
    rise = -tilt + 1
    rise = torch.where(rise.abs() < 1e-3, 1e-3, rise)  # pink noise itself has a logarithm there
    times = highest_hz / _NOISE_LOWEST_HZ
    return _NOISE_LOWEST_HZ**-tilt * _NOISE_LOWEST_HZ * (1 + (times**rise - 1) / rise)


def noise_floor(wave: Tensor) -> Tensor:
    """(..., samples) -> (..., 1), root mean square of each item's quieter parts, without what is constant in it."""
    wave = wave - wave.mean(dim=-1, keepdim=True)  # what a cheap sound card's converter adds is no sound
    blocks = wave[..., : wave.shape[-1] // 16 * 16].unflatten(-1, (16, -1))
    levels = blocks.square().mean(dim=-1).sqrt().sort(dim=-1).values  # (..., 16)
    return levels[..., 3:4].lerp(levels[..., 4:5], 0.75)  # the first quartile; torch's own asks the host


class RecordedNoise:
    """The recordings of a folder and its subfolders, in memory, all equally loud.

    Args:
        folder: Of WAV and FLAC files, at most two hours in all; several channels become their mean. Files of such a name that
            hold no sound, as a Mac leaves beside others, are left out, and a line of the log says so.
        sample_rate: Of the sound that they are mixed into [Hz].

    Raises:
        InputError: There are none, or one of them is silent; the message says which.
    """

    def __init__(self, folder: str | Path, sample_rate: int):
        option, folder = f"--policy.audio_noise_files={folder}", Path(folder)
        if not folder.is_dir():
            raise InputError(f"{option}: there is no such folder; wanted one with WAV or FLAC files, or null.")
        files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _ENDINGS and path.is_file())
        self._recordings: list[Tensor] = []
        seconds = 0.0
        for path in files:
            try:
                wave, rate = _mean_of_channels(path, _MOST_SECONDS - seconds)
            except AudioFileError as error:
                logger.warning("%s: %s It is left out: mend the file, or take it out of the folder.", option, error)
                continue
            if wave is None:
                raise InputError(f"{option}: the files last more than {_MOST_SECONDS // 3600} hours: take some out.")
            seconds += len(wave) / rate
            wave = resample(wave - wave.mean(), rate, sample_rate)
            level = float(np.sqrt(np.mean(np.square(wave))))
            if level < _SILENCE:
                raise InputError(f"{option}: {path} is silent: take it out of the folder.")
            self._recordings.append(torch.from_numpy(wave / level).half())
        if not self._recordings:
            raise InputError(
                f"{option}: the folder holds no {' or '.join(_ENDINGS)} file with sound: put some noise into it."
            )

    def __len__(self) -> int:
        return len(self._recordings)

    def excerpts(self, n_items: int, n_samples: int) -> Tensor:
        """A stretch of a recording for every item, both drawn evenly; short recordings repeat.

        Returns:
            (n_items, n_samples) float32; over a whole recording the root mean square is 1.
        """
        found = torch.empty(n_items, n_samples)
        for row, index in enumerate(torch.randint(len(self), (n_items,)).tolist()):
            recording = self._recordings[index]
            start = int(torch.randint(len(recording), ()))
            repeated = torch.arange(start, start + n_samples) % len(recording)
            found[row] = recording[repeated]
        return found


def _mean_of_channels(path: Path, most_seconds: float) -> tuple[np.ndarray | None, int]:
    """A file's sound, (n,) float32, and its sample rate; None if it is longer than that."""
    parts: list[np.ndarray] = []
    n_samples, rate = 0, 1
    for piece, rate in audio_pieces(path):
        n_samples += len(piece)
        if n_samples > most_seconds * rate:
            return None, rate
        parts.append(piece.mean(axis=1, dtype=np.float32) / 32768)
    return np.concatenate(parts), rate
