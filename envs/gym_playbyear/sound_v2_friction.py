"""Friction: noise that grows with normal force and slip speed, and whose band follows the slip speed.

Rough surfaces that slide are a rain of small blows between asperities (Ben Abdelounis et al., "An experimental study on
roughness noise of dry rough flat surfaces", 2010). Its amplitude grows with speed to the power 3/4 ("Influence of sliding
speed on roughness noise", 2019), and is taken to grow with the root of the normal force, as many independent blows do. It is
strongest at slip speed over distance of asperities. It rings the modes of both bodies, and is heard as a hiss besides (how the
two compare is chosen).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import signal

from gym_playbyear.contact_kinematics import Contacts, SoundingPair
from gym_playbyear.materials_v2 import material
from gym_playbyear.sound_timing import Smoother
from gym_playbyear.sound_v2_blows import smooth_step

_AUDIBLE_SLIP = (0.003, 0.01)  # m/s: solvers let what they hold creep
_SMOOTHING = 0.02  # s: what slides hops a little in MuJoCo, and is taken to press as much as it does on average
_SILENT = 1e-9  # of N (m/s)^1.5
_REFERENCE_SPEED = 0.1  # m/s, at which `_RUBBING` and `_HISSING` hold, with 1 N
_RUBBING = 0.004  # strength of the kicks to the modes [1/sqrt(s)] (chosen)
_HISSING = 0.016  # amplitude of the hiss beside a body of loudness 1 (chosen)
_LOWEST_BAND = 50.0  # Hz


class Rubs(NamedTuple):
    """How strong, and in which band.

    Attributes:
        amplitude: 1 for hard things at 1 N and 0.1 m/s, (n_substeps, n_pairs).
        band: Where it is strongest in this control step, (n_pairs,) [Hz].
    """

    amplitude: np.ndarray
    band: np.ndarray


class Friction:
    """Finds friction in the contacts of one control step after the other, and makes its noise.

    Args:
        pairs: As in `Contacts`.
        physics_dt: [s].
        n_substeps: Physics steps in a control step.
        sample_rate: [1/s].
        n_ears: Number of microphones.
    """

    def __init__(
        self, pairs: Sequence[SoundingPair], physics_dt: float, n_substeps: int, sample_rate: int, n_ears: int
    ) -> None:
        materials = [[material(name) for name in pair.materials] for pair in pairs]
        self._roughness = np.array([np.sqrt(a.roughness * b.roughness) for a, b in materials])
        # What is soft neither scratches nor is scratched: a finger on a cloth is as quiet as the cloth.
        self._level = np.array([a.loudness * b.loudness for a, b in materials])
        self._smoother = Smoother(n_substeps, physics_dt, _SMOOTHING)
        self._n_ears, self._sample_rate = n_ears, sample_rate
        self._duration = physics_dt * n_substeps
        n_samples = round(sample_rate * self._duration)
        self._edges = np.arange(n_substeps + 1.0)
        self._place = np.arange(1, n_samples + 1) * n_substeps / n_samples

    def reset(self, rng: np.random.Generator, roughness: np.ndarray, loudness: np.ndarray) -> None:
        """Starts an episode: `rng` for all its noise; factors for each pair."""
        self._rng = rng
        self._spacing = self._roughness * roughness
        self._hiss_level = _HISSING * loudness
        self._smoother.reset(np.zeros(2 * len(roughness)))
        self._filter_state = np.zeros(2)
        self._band = 1000.0
        self._last_envelope: np.ndarray = np.zeros((self._n_ears, 1))

    def find(self, contacts: Contacts) -> Rubs | None:
        """The friction of a control step, or None for silence."""
        slip = contacts.slip_speed
        slips = slip.max(initial=0.0) > _AUDIBLE_SLIP[0]
        if not slips and not self._smoother.value.any():
            return None
        power = contacts.normal_force * slip * np.sqrt(slip) * smooth_step(slip, _AUDIBLE_SLIP)
        smoothed = self._smoother.next(np.hstack([power, power * slip]))
        smoothed[smoothed < _SILENT] = 0.0
        self._smoother.value[self._smoother.value < _SILENT] = 0.0
        n_pairs = slip.shape[1]
        totals = smoothed.sum(axis=0)
        speed = totals[n_pairs:] / np.maximum(totals[:n_pairs], _SILENT)
        amplitude = np.sqrt(smoothed[:, :n_pairs] * _REFERENCE_SPEED**-1.5) * self._level
        return Rubs(amplitude, np.maximum(speed / self._spacing, _LOWEST_BAND))

    def kicks(
        self, rubs: Rubs, gains: np.ndarray, weights: np.ndarray, frequencies: np.ndarray, cell: float
    ) -> np.ndarray:
        """What friction adds to modes at the start of each cell: every mode has noise of its own, which all pairs make louder.

        Args:
            rubs: Of this control step.
            gains: To the microphones, (n_ears, n_substeps, n_pairs).
            weights: Of each pair on each mode, (n_pairs, n_modes).
            frequencies: Of the modes [Hz], (n_modes,).
            cell: Duration of a cell [s].

        Returns:
            (n_ears, n_cells, n_modes) complex.
        """
        sliding = rubs.amplitude.any(axis=0)
        modes = np.flatnonzero(weights[sliding].any(axis=0))  # of bodies that slide; the others need no noise
        on_modes = (weights[:, modes] * band_shape(frequencies[modes], rubs.band[:, None])) ** 2  # (n_pairs, modes)
        strength = np.sqrt((gains * rubs.amplitude) ** 2 @ on_modes) * (_RUBBING * np.sqrt(cell))
        repeat = round(self._duration / cell / strength.shape[1])
        if repeat > 1:
            strength = np.repeat(strength, repeat, axis=1)
        noise = self._rng.standard_normal((strength.shape[1], 2 * len(modes))).view(complex)
        kicks = np.zeros((*strength.shape[:2], len(frequencies)), complex)
        kicks[:, :, modes] = strength * noise
        return kicks

    def hiss(self, rubs: Rubs | None, gains: np.ndarray | None) -> np.ndarray | None:
        """What is heard beside the modes, (n_ears, n_samples), or None; `gains` (n_ears, n_substeps, n_pairs)."""
        if rubs is None or gains is None:
            if not self._last_envelope.any():
                return None
            envelope = np.zeros((self._n_ears, len(self._edges) - 1))
        else:
            level = (rubs.amplitude * self._hiss_level) ** 2  # (n_substeps, n_pairs)
            envelope = np.sqrt((gains**2 * level).sum(axis=2))
            totals = level.sum(axis=0)
            band = float(totals @ rubs.band) / max(float(totals.sum()), _SILENT)
            self._band = min(max(band, _LOWEST_BAND), 0.4 * self._sample_rate)
        edges = np.concatenate([self._last_envelope, envelope], axis=1)
        self._last_envelope = edges[:, -1:]
        white = self._rng.standard_normal(len(self._place))
        noise, self._filter_state = signal.lfilter(
            *_band_filter(self._band, self._sample_rate), white, zi=self._filter_state
        )
        return noise * np.array([np.interp(self._place, self._edges, edge) for edge in edges])


def band_shape(frequency, strongest):
    """Amplitude of friction noise per root hertz at a frequency; all of it is as strong wherever its band lies [Hz, Hz]."""
    x = frequency / strongest
    return 2.0 * x / (1.0 + x * x) * np.sqrt(1000.0 / strongest)


def _band_filter(band: float, sample_rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Gives white noise of rms 1 the shape of `band_shape`, and rms 1: a resonance of quality 1/2, by bilinear transform."""
    w = np.tan(np.pi * band / sample_rate)
    pole = (1.0 - w) / (1.0 + w)
    gain = np.sqrt(0.5 * (1.0 - pole * pole))
    return gain * np.array([1.0, 0.0, -1.0]), np.array([1.0, -2.0 * pole, pole * pole])
