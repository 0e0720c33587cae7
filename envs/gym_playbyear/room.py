"""A task heard in another room, or by another microphone: what does a policy make of sound that it did not train with?"""

from functools import cache
from math import gcd
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.io import wavfile

from gym_playbyear.registry import OptionError, check_option
from gym_playbyear.sound.synthesizer import BACKGROUND_RMS, pcm16

RESPONSES: dict[str, tuple[str, float | tuple[float, float], float]] = {
    "flat": ("none", 0.0, 0.0),
    "phone": ("bandpass", (300.0, 3400.0), 0.0),
    "dull": ("lowpass", 900.0, 0.0),
    "boomy": ("lowpass", 300.0, 3.0),
}
"""Frequency responses: kind of a Butterworth filter of the first order, its corner frequencies [Hz], and how often what it
lets through is added to the sound; 0 puts it in the sound's place."""

_MOST_HZ = 10**6  # of a recording

# How a recording, which plays at one place, reaches a microphone: straight, and by reflections. All are chosen.
_GAIN_DB = 3.0  # either way: one stands nearer than another
_LATEST = 0.01  # s from the first microphone that hears it to the last: 3.4 m
_REFLECTIONS = 16
_REFLECTED_AFTER = (0.002, 0.12)  # s
_REVERBERATION = (0.15, 0.8)  # s to fall by 60 dB
_DIRECT_DB = (0.0, 15.0)  # of what comes straight, relative to all that is reflected


class Room:
    """A room where a recording plays, and a microphone of another frequency response.

    Args:
        microphones: Their names. All hear the same recording at the same time, each with a gain, a delay and reflections of its
            own, drawn for every episode.
        sample_rate: Samples per second.
        noise: A WAV file; it repeats. None: a silent room.
        noise_level: Root mean square of the whole recording, in units of the usual background's: within 3 dB of what is
            broadband; a room weakens and raises tones.
        response: One of `RESPONSES`.

    Raises:
        OptionError: The file cannot be read or is silent, or another value cannot be used.
    """

    def __init__(
        self,
        microphones: tuple[str, ...],
        sample_rate: int,
        noise: str | None = None,
        noise_level: float = 1.0,
        response: str = "flat",
    ):
        check_option("response", response, RESPONSES)
        if not 0.0 <= noise_level < np.inf:
            raise OptionError("room_noise_level", noise_level, "give 0 (silent) or more")
        self._microphones, self._sample_rate = microphones, sample_rate
        recording = np.zeros(1, np.float32) if noise is None else _recording(str(noise), sample_rate)
        self._recording = noise_level * BACKGROUND_RMS * recording
        kind, corner, self._added = RESPONSES[response]
        self._filter = None if response == "flat" else signal.butter(1, corner, kind, fs=sample_rate, output="sos")
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """An episode begins, somewhere in the recording."""
        shared, *each = rng.spawn(1 + len(self._microphones))  # so that a second microphone does not change the first
        self._place = int(shared.integers(len(self._recording)))
        self._draw_ways(shared, each)
        n_sections = 0 if self._filter is None else len(self._filter)
        self._state = np.zeros((n_sections, len(self._microphones), 2))

    def hear(self, heard: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What is heard there, int16, of what each microphone would hear without it, of one control step."""
        wave = np.stack([heard[name] for name in self._microphones]) / 32767.0  # (microphones, S)
        span = np.arange(wave.shape[1])
        if len(self._recording) > 1:
            heard_at = (self._place - self._delays[:, :, None] + span) % len(self._recording)  # (microphones, ways, S)
            wave += np.einsum("mw,mws->ms", self._gains, self._recording[heard_at])
        self._place = (self._place + len(span)) % len(self._recording)
        if self._filter is not None:
            passed, self._state = signal.sosfilt(self._filter, wave, zi=self._state)
            wave = wave + self._added * passed if self._added else passed
        return dict(zip(self._microphones, pcm16(wave), strict=True))

    def _draw_ways(self, shared: np.random.Generator, each: list[np.random.Generator]) -> None:
        """Delays [samples] and gains, each (microphones, ways): the first way is the straight one."""
        shortest, longest = np.log(_REVERBERATION)
        decay = np.log(1000.0) / np.exp(shared.uniform(shortest, longest))  # 1/s
        direct = 10 ** (shared.uniform(*_DIRECT_DB) / 20)
        self._delays = np.zeros((len(each), 1 + _REFLECTIONS), int)
        self._gains = np.zeros((len(each), 1 + _REFLECTIONS))
        earliest, latest = np.log(_REFLECTED_AFTER)
        for delays, gains, rng in zip(self._delays, self._gains, each, strict=True):
            after = np.exp(rng.uniform(earliest, latest, _REFLECTIONS))
            reflected = rng.standard_normal(_REFLECTIONS) * np.exp(-decay * after)
            delays[:] = np.rint((rng.uniform(0.0, _LATEST) + np.append(0.0, after)) * self._sample_rate)
            gains[:] = np.append(direct * np.linalg.norm(reflected), reflected)
            gains *= 10 ** (rng.uniform(-_GAIN_DB, _GAIN_DB) / 20) / np.linalg.norm(gains)


@cache
def _recording(path: str, sample_rate: int) -> np.ndarray:
    """A WAV file as one channel, (n,) float32 of root mean square 1, at this rate."""
    if not Path(path).is_file():
        raise OptionError("room_noise", path, "there is no such file, give a WAV file")
    try:
        rate, samples = wavfile.read(path)
        if not 0 < rate <= _MOST_HZ:
            raise ValueError(f"it has {rate} samples per second, wanted 1 to {_MOST_HZ}")
    except Exception as error:  # SciPy trusts what a file's head says, and divides and unpacks whatever it is
        raise OptionError("room_noise", path, f"it cannot be read as a WAV file ({error}), give another") from error
    wave = samples.astype(np.float64).reshape(len(samples), -1).mean(axis=1)
    wave -= wave.mean() if len(wave) else 0.0  # nobody hears it, and the level must not count it
    divisor = gcd(rate, sample_rate)
    wave = signal.resample_poly(wave, sample_rate // divisor, rate // divisor)
    level = np.sqrt(np.mean(np.square(wave))) if len(wave) else 0.0
    if not level > 0.0 or not np.isfinite(level):
        raise OptionError("room_noise", path, "it is silent, or not finite: give another recording")
    return (wave / level).astype(np.float32)
