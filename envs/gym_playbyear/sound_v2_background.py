"""What is heard without any contact: a noisy room, and the hand's own drive. The arm's motors are in `sound_hum`."""

import numpy as np
from scipy import signal

from gym_playbyear.sound_timing import Smoother

_NOISE_RMS = 10 ** (-61 / 20)  # up to `_NOISE_BAND_HZ`; full scale is a wave of amplitude 1
_NOISE_BAND_HZ = 8000.0
_DRIVE_RMS = 10 ** (-32 / 20)  # the hand's motor at full speed: a hand that closes is the loudest part of a robot
_DRIVE_SPEED = 0.05  # m/s of a finger: full speed of the real hand (Franka Hand, product manual)
_DRIVE_STILL = (0.0005, 0.004)  # m/s: slower is silent, faster turns the motor
_DRIVE_SMOOTHING = 0.004  # s
_DRIVE_FASTEST = 1.5  # times full speed
_TABLE = 4096  # values of one turn
_POLES = 4


class Noise:
    """Noise whose power falls as frequency to the power `tilt`, from a stream of its own for each microphone."""

    def __init__(self, rngs: list[np.random.Generator], sample_rate: int, tilt: float) -> None:
        self._rngs = rngs
        self._filter = _tilted(sample_rate, tilt)
        self._state = np.zeros((len(rngs), _POLES))
        self.next(sample_rate // 10)  # let the filter forget that it started from nothing

    def next(self, n_samples: int) -> np.ndarray:
        """(n_microphones, n_samples)."""
        white = np.stack([rng.standard_normal(n_samples) for rng in self._rngs])
        noise, self._state = signal.lfilter(*self._filter, white, zi=self._state)
        return noise


class Drive:
    """The hand's motor: its pitch and its level follow the speed of the fingers; still fingers are silent."""

    def __init__(
        self, phase: float, pitch: float, harmonics: np.ndarray, sample_rate: int, n_samples: int, n_substeps: int
    ) -> None:
        self._phase, self._pitch = phase, pitch / sample_rate
        heard = np.arange(1, len(harmonics) + 1) * pitch * _DRIVE_FASTEST < 0.45 * sample_rate
        turn = np.arange(_TABLE) / _TABLE
        waves = [amplitude * np.sin(2.0 * np.pi * n * turn) for n, amplitude in enumerate(harmonics * heard, start=1)]
        self._table = _DRIVE_RMS * np.sum(waves, axis=0)  # one turn
        self._smoother = Smoother(n_substeps, n_samples / sample_rate / n_substeps, _DRIVE_SMOOTHING)
        self._smoother.reset(np.zeros(1))
        self._edges = np.arange(n_substeps + 1.0)
        self._place = np.arange(1, n_samples + 1) * (n_substeps / n_samples)

    def next(self, speed: np.ndarray) -> np.ndarray | None:
        """The next samples, (n_samples,), or None; `speed` of a finger at every physics step, (n_substeps,) [m/s]."""
        before = self._smoother.value
        if speed.max() < _DRIVE_STILL[0] and before[0] < _DRIVE_STILL[0]:
            before[:] = 0.0
            return None
        smooth = np.concatenate([before, self._smoother.next(speed[:, None])[:, 0]])
        turning = np.interp(self._place, self._edges, np.minimum(smooth / _DRIVE_SPEED, _DRIVE_FASTEST))
        phase = self._phase + np.cumsum(turning) * self._pitch  # in turns
        self._phase = float(phase[-1] % 1.0)
        still, full = (limit / _DRIVE_SPEED for limit in _DRIVE_STILL)
        level = np.sqrt(turning) * np.minimum(np.maximum((turning - still) / (full - still), 0.0), 1.0)
        return self._table[(phase * _TABLE).astype(int) % _TABLE] * level


def _tilted(sample_rate: int, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that make white noise fall as frequency to the power `tilt`, equally loud at every sample rate."""
    ratio = 4.5  # from pole to pole, 40 Hz to 16 kHz in all, each with a zero above it
    poles = -2 * np.pi * 40.0 * ratio ** np.arange(_POLES)
    zeros = poles * ratio ** (0.5 * tilt)
    band = np.linspace(0.0, _NOISE_BAND_HZ, 4001)
    power = np.mean(np.abs(signal.freqs_zpk(zeros, poles, 1.0, worN=2 * np.pi * band)[1]) ** 2)
    gain = _NOISE_RMS / np.sqrt(power * _NOISE_BAND_HZ / (0.5 * sample_rate))
    numerator, denominator = signal.zpk2tf(*signal.bilinear_zpk(zeros, poles, 1.0, sample_rate))
    return gain * numerator, denominator
