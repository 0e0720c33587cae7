"""Rings all modes of all bodies, for all microphones at once, without a loop over samples or physics steps.

A mode is a complex number per microphone. Time is cut into cells of at most a millisecond: at the start of a cell friction
kicks the modes; from cell to cell they turn and decay by a constant; the samples within a cell are the numbers times a fixed
table. A blow comes at its own time within a cell, to a fraction of a sample.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gym_playbyear.sound.materials import Material

_LONGEST_CELL = 0.001  # s
_INAUDIBLE = 1e-7  # modes below this amplitude are stopped; half a step of 16-bit sound is 1.5e-5
_MOST_DECAY = 600.0  # in a control step, as a power of e: more than that, and squares overflow


class Arrivals(NamedTuple):
    """Blows as microphones hear them: when [s after the control step's start], who, and how much of each mode.

    time: (n,). ear: (n,), index of the microphone. amplitudes: (n, n_modes).
    """

    time: np.ndarray
    ear: np.ndarray
    amplitudes: np.ndarray


class ModeBank:
    """All bodies' modes, one after the other.

    Args:
        materials: Of each body.
        n_ears: Number of microphones.
        sample_rate: [1/s].
        n_samples: In a control step.
        n_substeps: Physics steps in a control step.
    """

    def __init__(
        self, materials: Sequence[Material], n_ears: int, sample_rate: int, n_samples: int, n_substeps: int
    ) -> None:
        self.body_of_mode = np.repeat(np.arange(len(materials)), [len(m.frequencies) for m in materials])
        self.amplitudes = np.concatenate([m.amplitudes() for m in materials])
        self._frequencies = np.concatenate([m.frequencies for m in materials])
        self._decays = np.concatenate([m.decays for m in materials])
        self._n_ears, self._sample_rate, self._n_samples = n_ears, sample_rate, n_samples
        self._duration = n_samples / sample_rate
        self.cells_per_substep = int(np.ceil(self._duration / n_substeps / _LONGEST_CELL - 1e-6))
        self.n_cells = n_substeps * self.cells_per_substep
        self.cell = self._duration / self.n_cells
        edges = np.arange(self.n_cells + 1) * n_samples / self.n_cells
        self._first = np.ceil(edges - 1e-9).astype(int)  # sample of each cell; a cell need not hold a whole number
        self._lead = (self._first - edges)[:-1] / sample_rate  # from a cell to its first sample [s]
        self._longest = int(np.diff(self._first).max())
        sample = np.arange(n_samples)
        in_cell = np.searchsorted(self._first, sample, side="right") - 1
        self._samples: np.ndarray | slice = in_cell * self._longest + sample - self._first[in_cell]
        if n_samples == self.n_cells * self._longest:
            self._samples = slice(None)  # spares a copy

    def reset(self, pitch: np.ndarray, damping: np.ndarray) -> None:
        """Silence, with every mode's frequency and decay times a factor, both (n_modes,)."""
        self.frequencies = self._frequencies * pitch
        self.decays = np.minimum(self._decays * damping, _MOST_DECAY / self._duration)
        poles = -self.decays + 2j * np.pi * self.frequencies
        self._poles = poles
        self._power = np.exp(poles * self.cell)
        self._powers = np.exp(poles * self.cell * np.arange(self.n_cells)[:, None])  # (n_cells, n_modes)
        self._undo = 1.0 / self._powers
        self._until_sample = self._powers * np.exp(poles * self._lead[:, None])
        wave = np.exp(poles[:, None] * np.arange(self._longest) / self._sample_rate)
        wave[self.frequencies > 0.45 * self._sample_rate] = 0.0  # no sample rate can hold what lies above its half
        # A body that is struck starts as a sine, from rest: the imaginary part.
        self._table = np.concatenate([wave.imag, wave.real]).astype(np.float32)  # (2 n_modes, samples of a cell)
        self._state = np.zeros((self._n_ears, len(poles)), complex)
        self._late: Arrivals | None = None

    def ring(self, kicks: np.ndarray | None, arrivals: Arrivals | None) -> np.ndarray | None:
        """The next control step.

        Args:
            kicks: Added to the modes at the start of each cell, (n_ears, n_cells, n_modes), or None.
            arrivals: Blows of this step, or None; those that come later than it are kept.

        Returns:
            (n_ears, n_samples), or None for silence.
        """
        arrivals = self._in_time(arrivals)
        if kicks is None and arrivals is None and not self._state.any():
            return None
        drive = np.zeros((self._n_ears, self.n_cells + 1, len(self._poles)), complex)
        if kicks is not None:
            drive[:, :-1] = kicks
        starts = None if arrivals is None else self._strike(arrivals, drive)
        # z[k] = P z[k-1] + drive[k], for all k at once: z[k] = P^k (z[0] + sum over j <= k of drive[j] P^-j).
        if kicks is None and starts is None:
            sums = self._state[:, None]
        else:
            sums = self._state[:, None] + np.cumsum(drive[:, :-1] * self._undo, axis=1)
        segments = self._sound(sums * self._until_sample).reshape(self._n_ears, -1)[:, self._samples]
        self._state = sums[:, -1] * (self._powers[-1] * self._power) + drive[:, -1]
        if np.abs(self._state).sum() < _INAUDIBLE:
            self._state = np.zeros_like(self._state)
        if starts is not None:
            np.add.at(segments, starts[0], starts[1])
        return segments

    def _in_time(self, arrivals: Arrivals | None) -> Arrivals | None:
        """This step's arrivals, with those that were late; keeps the ones that come after it."""
        both = [each for each in (self._late, arrivals) if each is not None]
        self._late = None
        if not both:
            return None
        known = both[0] if len(both) == 1 else Arrivals(*(np.concatenate(column) for column in zip(*both, strict=True)))
        late = known.time >= self._duration
        if late.any():
            self._late = Arrivals(known.time[late] - self._duration, known.ear[late], known.amplitudes[late])
            known = Arrivals(*(column[~late] for column in known))
        return known if len(known.time) else None

    def _strike(self, arrivals: Arrivals, drive: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Adds blows to the cell after theirs; returns the samples that they sound in their own: places and values."""
        time, ear, amplitudes = arrivals
        cell = np.minimum((time / self.cell).astype(int), self.n_cells - 1)
        rest = (cell + 1) * self.cell - time
        np.add.at(drive, (ear, cell + 1), amplitudes * np.exp(self._poles * rest[:, None]))
        first = np.ceil(time * self._sample_rate - 1e-9).astype(int)
        wait = first / self._sample_rate - time
        start = self._sound(amplitudes * np.exp(self._poles * wait[:, None]))  # (n, samples of a cell)
        sample = first[:, None] + np.arange(self._longest)
        start = np.where(sample < self._first[cell + 1, None], start, 0.0)
        return (np.repeat(ear, self._longest), np.minimum(sample, self._n_samples - 1).ravel()), start.ravel()

    def _sound(self, modes: np.ndarray) -> np.ndarray:
        """(..., n_modes) complex -> (..., samples of a cell)."""
        return np.concatenate([modes.real, modes.imag], axis=-1).astype(np.float32) @ self._table
