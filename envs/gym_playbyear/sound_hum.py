"""The hum of an arm's motors."""

import math

import numpy as np

HUM_RMS = 10 ** (-69 / 20)  # of an arm at rest; full scale is a wave of amplitude 1

# Growth of the level with the joints' speed, and its speed scale [rad/s]; and its response time [s]: so slow that an arm
# checked by a contact does not tell.
_GROWTH, _SPEED, _SECONDS = 0.5, 0.5, 1.0


class Hum:
    """A steady tone with harmonics, whose level follows the joints' speed slowly.

    Args:
        phases: Of the harmonics, in turns.
        pitch: Of the first one [Hz].
        amplitudes: Of the harmonics while the arm rests.
        sample_rate: Samples per second.
        n_samples: Of a control step.
    """

    def __init__(
        self, phases: np.ndarray, pitch: float, amplitudes: np.ndarray, sample_rate: int, n_samples: int
    ) -> None:
        angles = 2j * np.pi * pitch * np.arange(1, len(amplitudes) + 1) / sample_rate
        self._harmonics = amplitudes * np.exp(2j * np.pi * phases)
        self._turn = np.exp(angles * n_samples)
        wave = np.exp(angles[:, None] * np.arange(n_samples))
        self._table = np.concatenate([wave.imag, wave.real]).astype(np.float32)  # (2 n_harmonics, n_samples)
        self._ramp = np.linspace(0.0, 1.0, n_samples, dtype=np.float32)
        self._response = -np.expm1(-n_samples / (sample_rate * _SECONDS))
        self._speed = 0.0

    def next(self, speed: float) -> np.ndarray:
        """The next samples, (n_samples,), while the joints move at `speed` [rad/s]."""
        before = self._level()
        self._speed += self._response * (speed - self._speed)
        parts = np.concatenate([self._harmonics.real, self._harmonics.imag]).astype(np.float32)
        self._harmonics = self._harmonics * self._turn
        return (parts @ self._table) * (before + (self._level() - before) * self._ramp)

    def _level(self) -> float:
        return 1.0 + _GROWTH * math.tanh(self._speed / _SPEED)
