"""What training does to sound, so that the policy bears other rooms and other microphones: noise that is drawn, recordings of
rooms, radios and tools, and another microphone's response."""

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

_FAINTEST_DB = -20.0  # of what is mixed in, relative to an item's noise floor
_NOISE_TILT = (0.0, 1.2)  # exponent of 1 / frequency: from white to a little steeper than pink
_NOISE_LOWEST_HZ = 20.0  # below it noise grows no further
_HUM_HZ = (45.0, 75.0)
_HUM_HARMONICS = 4
_HUM_DB = (-20.0, 0.0)  # relative to the broadband noise
_RECORDED_SHARE = 0.75  # of the items that get recorded noise
_RECORDED_FAINTEST_DB = 0.0  # of it, relative to an item's noise floor, unless the loudest is fainter
_ENDINGS = (".wav", ".flac")  # of files with recorded noise
_MOST_SECONDS = 7200  # of all recordings
_SILENCE = 1e-5  # root mean square
_LEAKAGE = 8  # bins above the highest one that is kept, whose noise still reaches it
_COLOUR_POINTS = 6  # of a microphone's response, evenly spaced in octaves

logger = logging.getLogger(__name__)


class SoundAugmentation(nn.Module):
    """Noise and another microphone's response, drawn for every item; nothing of it is in a checkpoint."""

    response: Tensor

    def __init__(self, config: PlaybyearConfig):
        super().__init__()
        assert config.sample_rate is not None
        self.sample_rate, self.max_db = config.sample_rate, config.audio_noise_db
        self.files, self.colour_db = config.audio_noise_files, config.audio_colour_db
        self.highest_hz = (config.n_frequency_bins + _LEAKAGE) / config.segment_s
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

    def noisy(self, wave: Tensor) -> Tensor:
        """(B, samples) in [-1, 1] -> the same shape, with noise.

        Raises:
            InputError: The folder of recorded noise cannot be used.
        """
        if self.max_db is None:
            return wave
        mixed = mix_in_noise(wave, self.max_db, self.sample_rate, self.highest_hz)
        self.read_recordings()
        if self._recorded is None:
            return mixed
        excerpts = self._recorded.excerpts(*wave.shape).to(wave.device)
        draws = torch.rand(2, len(wave), 1, device=wave.device)
        faintest = min(_RECORDED_FAINTEST_DB, self.max_db)
        level = faintest + (self.max_db - faintest) * draws[0]  # [dB]
        gain = 10 ** (level / 20) * (draws[1] < _RECORDED_SHARE)
        return mixed + noise_floor(wave) * gain * excerpts

    def colour(self, n_items: int) -> Tensor | None:
        """A microphone's gain in every bin of the spectrogram, a smooth curve, (n_items, bins) [10 dB]."""
        if self.colour_db == 0:
            return None
        points = torch.randn(n_items, _COLOUR_POINTS, device=self.response.device)
        return self.colour_db / 10 * points @ self.response.T


def mix_in_noise(wave: Tensor, max_db: float, sample_rate: int, highest_hz: float = math.inf) -> Tensor:
    """Adds a room's noise to training sound: broadband, of another colour and level in every item, with a mains-like hum.

    White noise alone teaches nothing about rooms, whose noise is louder the lower it is. Drawn per item, uniformly: the
    level, between 20 dB below the item's own noise floor and `max_db` above it; the tilt, power falling as frequency to the
    power 0 to 1.2; the hum's pitch, 45 to 75 Hz with three overtones; and its level, from 20 dB below the broadband noise to
    as loud.

    Args:
        wave: (B, samples), in [-1, 1].
        max_db: Loudest broadband noise relative to the floor [dB].
        sample_rate: Of the waveform [Hz].
        highest_hz: Noise above it is left out, for an ear that does not hear it; levels are still those of all of it [Hz].

    Returns:
        (B, samples).
    """
    n_items, n_samples = wave.shape
    draws = torch.rand(4, n_items, 1, device=wave.device)
    ranges = zip(((_FAINTEST_DB, max_db), _NOISE_TILT, _HUM_HZ, _HUM_DB), draws, strict=True)
    level, tilt, pitch, hum = (low + (high - low) * draw for (low, high), draw in ranges)
    resolution = sample_rate / n_samples  # [Hz] of a bin
    n_bins = n_samples // 2  # without the constant part
    n_drawn = min(n_bins, math.ceil(min(highest_hz, sample_rate) / resolution))
    frequency = resolution * torch.arange(1, n_drawn + 1, device=wave.device)
    power = frequency.clamp(min=_NOISE_LOWEST_HZ) ** -tilt  # (B, drawn)
    power = power * (resolution / _power_below(sample_rate / 2, tilt))
    overtones = torch.arange(1, _HUM_HARMONICS + 1, device=wave.device)
    bins = (pitch * overtones / resolution).round().long().clamp(1, n_drawn) - 1  # (B, harmonics)
    power = power.scatter_add(1, bins, (10 ** (hum / 10) / _HUM_HARMONICS).expand(-1, _HUM_HARMONICS))
    amplitude = noise_floor(wave) * 10 ** (level / 20) * power.sqrt() / 2  # as of both signs of a frequency
    spectrum = torch.randn(n_items, n_drawn, 2, device=wave.device) * amplitude.unsqueeze(2)
    spectrum = functional.pad(spectrum, (0, 0, 1, n_bins - n_drawn))  # (B, bins + 1, 2)
    return wave + torch.fft.irfft(torch.view_as_complex(spectrum), n=n_samples, norm="forward")


def _power_below(highest_hz: float, tilt: Tensor) -> Tensor:
    """Integral of the noise's power over frequency, in its own units."""
    rise = -tilt + 1
    rise = torch.where(rise.abs() < 1e-3, 1e-3, rise)  # pink noise itself has a logarithm there
    times = highest_hz / _NOISE_LOWEST_HZ
    return _NOISE_LOWEST_HZ**-tilt * _NOISE_LOWEST_HZ * (1 + (times**rise - 1) / rise)


def noise_floor(wave: Tensor) -> Tensor:
    """(B, samples) -> (B, 1), root mean square of each item's quieter parts, without what is constant in it."""
    wave = wave - wave.mean(dim=1, keepdim=True)  # what a cheap sound card's converter adds is no sound
    blocks = wave[:, : wave.shape[1] // 16 * 16].unflatten(1, (16, -1))
    levels = blocks.square().mean(dim=2).sqrt().sort(dim=1).values  # (B, 16)
    return levels[:, 3:4].lerp(levels[:, 4:5], 0.75)  # the first quartile; torch's own asks the host


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
