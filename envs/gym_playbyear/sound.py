"""The sound of contact: what microphones hear of the forces that the physics computes.

Every change of a contact force strikes both partners, which ring in the modes of their materials. A steady
force is silent, an onset is a click that rings, a fluctuating force (sliding) is a scrape. A microphone hears
at full level what its structure touches, and everything else through the air, weaker (paper, real-robot
set-up: the microphone touches the gripper and hears both air- and structure-borne sound, without noise
reduction). Background noise and the arm's motors are always there. Nothing silent is audible.
"""

from collections.abc import Sequence

import numpy as np
from scipy import signal

from gym_playbyear import materials
from gym_playbyear.materials import MATERIALS, MICROPHONES, ContactPair, Material, Microphone
from gym_playbyear.sound_hum import HUM_RMS, Hum
from gym_playbyear.sound_timing import physics_steps, samples_per_step

__all__ = ["MATERIALS", "MICROPHONES", "ContactPair", "ContactSound", "Material", "Microphone", "pcm16"]

# Levels: full scale (0 dBFS) is a wave of amplitude 1. All are our own choice.
_NOISE_RMS = 10 ** (-61 / 20)  # broadband background up to _NOISE_BAND_HZ
_NOISE_BAND_HZ = 8000.0
_TOUCH_RMS = 10 ** (-28 / 20)  # both partners of a touch, struck by a force step of 1 N, over _TOUCH_SECONDS
_TOUCH_SECONDS = 0.05
_AIR_GAIN = 10 ** (-30 / 20)  # air-borne relative to structure-borne
_RELEASE_GAIN = 0.3  # letting go is quieter than hitting

# Force changes per physics step below the first are solver jitter: silent; above the second all counts [N].
_DEAD_ZONE_N = (0.1, 0.5)

# Spreads: of a body's pitch between episodes, of the mix of its modes between contacts, of a blow's strength.
_PITCH_SPREAD = 0.02
_MIX_SPREAD = 0.2
_STRENGTH_SPREAD = 0.2

# Motors: pitch [Hz], which an episode draws, and relative amplitudes of the harmonics.
_HUM_HZ = (55.0, 65.0)
_HUM_HARMONICS = np.array([0.81, 0.49, 0.28, 0.16])

_INAUDIBLE = 1e-6  # modes below this amplitude are stopped; half a step of 16-bit sound is 1.5e-5


def pcm16(wave: np.ndarray) -> np.ndarray:
    """Converts a wave in [-1, 1] to 16-bit samples of the same shape; what lies outside is clipped."""
    return np.rint(np.clip(wave, -1.0, 1.0) * 32767.0).astype(np.int16)


class ContactSound:
    """Synthesises what each microphone hears, one control step at a time, without seams between steps.

    A mode is a complex number: a blow adds to it, a physics step multiplies it by a constant, and the samples
    in that step are the number times a fixed table. A control step is one cumulative sum and one matrix product.

    Args:
        pairs: Contacts that can be heard, in the order of the columns of `forces`.
        microphones: Names in `MICROPHONES`.
        sample_rate: Samples per second, at least 8,000, and a multiple of `control_hz`.
        control_hz: Control steps per second.
        physics_dt: Duration of a physics step [s]; a control step holds a whole number of them.
        noise_level: Factor on noise and hum; 1 puts their sum at about -60 dBFS rms, 0 turns both off.

    Raises:
        ValueError: For a rate, microphone or noise level that cannot be used.
    """

    def __init__(
        self,
        pairs: Sequence[ContactPair],
        microphones: Sequence[str],
        sample_rate: int,
        control_hz: int,
        physics_dt: float,
        noise_level: float = 1.0,
    ) -> None:
        self.pairs = tuple(pairs)
        self.microphones = _microphones(microphones)
        self.sample_rate, self.control_hz, self.physics_dt = sample_rate, control_hz, physics_dt
        self.samples_per_step = samples_per_step(sample_rate, control_hz)
        self.n_substeps = physics_steps(control_hz, physics_dt)
        if not 0.0 <= noise_level < np.inf:
            raise ValueError(f"noise_level is {noise_level}; it must be 0 (silent background) or greater.")
        self.noise_level = float(noise_level)
        self._noise_filter = _pink_filter(sample_rate)
        self._hum_levels = np.array([[microphone.hum] for microphone in self.microphones], np.float32)
        self._links = [microphone.structure_borne(self.pairs) for microphone in self.microphones]
        self._lay_out_modes()
        self._lay_out_samples()
        self.reset(np.random.default_rng(0))

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode in silence, every body at its own pitch. What touches already makes no click."""
        # Separate streams: the number of blows changes neither the noise nor the blows of another pair.
        pitch_rng, self._blow_rng, self._noise_rng, *self._mix_rngs = rng.spawn(3 + len(self.pairs))
        self._tune_modes(pitch_rng)
        self._mixes = [self._draw_mixes(pair, 1)[0] for pair in range(len(self.pairs))]
        self._modes = np.zeros((len(self.microphones), len(self._frequencies)), complex)
        self._last_forces: np.ndarray | None = None
        self._noise_state = np.zeros((len(self.microphones), len(self._noise_filter[1]) - 1), np.float32)
        self._noise(self.sample_rate // 10)  # let the filter forget that it started from nothing
        pitch, phases = self._noise_rng.uniform(*_HUM_HZ), self._noise_rng.uniform(size=len(_HUM_HARMONICS))
        amplitudes = HUM_RMS * np.sqrt(2.0) * _HUM_HARMONICS
        self._hum = Hum(phases, pitch, amplitudes, self.sample_rate, self.samples_per_step)

    def step(self, forces: np.ndarray, joint_speed: np.ndarray) -> dict[str, np.ndarray]:
        """Synthesises the sound of one control step.

        Args:
            forces: Magnitude of each pair's net force at every physics step [N], (n_substeps, n_pairs).
            joint_speed: Mean absolute speed of the arm's joints at every physics step [rad/s], (n_substeps,).

        Returns:
            For each microphone its samples, int16, (sample_rate / control_hz,).

        Raises:
            ValueError: If `forces` has another shape, or a value is not finite.
        """
        forces, speed = np.asarray(forces, dtype=float), float(np.mean(joint_speed))
        if forces.shape != (self.n_substeps, len(self.pairs)):
            wanted = (self.n_substeps, len(self.pairs))
            raise ValueError(f"forces has shape {forces.shape}; wanted {wanted}: (physics steps, contact pairs).")
        if not np.isfinite(forces.sum() + speed):
            raise ValueError("A force or joint speed is not finite: the simulation diverged; reduce physics_dt.")
        wave = self._ring(forces)  # (n_microphones, S)
        if self.noise_level > 0.0:
            hum = self._hum_levels * self._hum.next(speed)
            wave = wave + self.noise_level * (self._noise(self.samples_per_step) + hum)
        samples = pcm16(np.tanh(wave))  # a hard blow saturates softly
        return {microphone.name: row for microphone, row in zip(self.microphones, samples, strict=True)}

    def _ring(self, forces: np.ndarray) -> np.ndarray:
        strengths, mixes = self._blows(forces)
        struck = np.flatnonzero(strengths.any(axis=0))
        if not len(struck) and not self._modes.any():
            return np.zeros((len(self.microphones), self.samples_per_step), np.float32)
        drive = np.zeros((self.n_substeps, *self._modes.shape))  # (n_substeps, n_microphones, n_modes)
        for pair in struck:
            blows = strengths[:, pair, None] * mixes[pair]  # (n_substeps, modes of the pair)
            for index, links in enumerate(self._links):
                drive[:, index, self._pair_modes[pair]] += _path_gain(forces, links[pair]) * blows
        # z[k] = P z[k-1] + drive[k], for all k at once: z[k] = P^k (z[0] + sum over j <= k of drive[j] P^-j).
        states = self._powers * (self._modes + np.cumsum(drive / self._powers, axis=0))
        self._modes = states[-1] * self._power
        if np.abs(self._modes).sum() < _INAUDIBLE:
            self._modes = np.zeros_like(self._modes)
        states = (states * self._advance).transpose(1, 0, 2)  # (n_microphones, n_substeps, n_modes)
        parts = np.concatenate([states.real, states.imag], axis=-1).astype(np.float32)
        segments = parts @ self._table  # (n_microphones, n_substeps, samples of a physics step)
        return segments.reshape(len(self.microphones), -1)[:, self._samples]

    def _blows(self, forces: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Strength of every blow (n_substeps, n_pairs), and for each pair the amplitudes of its modes."""
        earlier = np.vstack([forces[:1] if self._last_forces is None else self._last_forces, forces[:-1]])
        self._last_forces = forces[-1:].copy()
        change = forces - earlier
        size = np.abs(change)
        above = np.clip((size - _DEAD_ZONE_N[0]) / (_DEAD_ZONE_N[1] - _DEAD_ZONE_N[0]), 0.0, 1.0)
        strengths = np.sqrt(size) * above**2 * (3.0 - 2.0 * above) * np.where(change < 0.0, _RELEASE_GAIN, 1.0)
        # Drawn for every physics step, blow or not, so that it does not matter where control steps begin.
        # Random signs keep a steady scrape from becoming a tone at the physics rate.
        rough = self._blow_rng.uniform(-1.0, 1.0, forces.shape)
        strengths *= np.sign(rough) * (1.0 + _STRENGTH_SPREAD * (2.0 * np.abs(rough) - 1.0))
        return strengths, self._mix((earlier <= 0.0) & (forces > 0.0))

    def _mix(self, onsets: np.ndarray) -> list[np.ndarray]:
        """Amplitudes of each pair's modes, (n_substeps or 1, modes): a new contact, elsewhere, mixes them anew."""
        mixes = [mix[None] for mix in self._mixes]
        for pair in np.flatnonzero(onsets.any(axis=0)):
            contact = np.cumsum(onsets[:, pair])
            known = np.vstack([self._mixes[pair], self._draw_mixes(pair, int(contact[-1]))])
            mixes[pair], self._mixes[pair] = known[contact], known[-1]
        return mixes

    def _draw_mixes(self, pair: int, count: int) -> np.ndarray:
        amplitudes = self._amplitudes[self._pair_modes[pair]]
        spread = self._mix_rngs[pair].standard_normal((count, len(amplitudes)))
        return amplitudes * np.exp(_MIX_SPREAD * spread)

    def _noise(self, n_samples: int) -> np.ndarray:
        white = self._noise_rng.standard_normal((len(self.microphones), n_samples), dtype=np.float32)
        noise, self._noise_state = signal.lfilter(*self._noise_filter, white, zi=self._noise_state)
        return noise

    # Tables: computed once, or once per episode.

    def _lay_out_modes(self) -> None:
        """One bank of modes per body, which all the pairs of that body strike."""
        sides = [tuple(zip(pair.bodies, pair.materials, strict=True)) for pair in self.pairs]
        banks = list(dict.fromkeys(side for pair in sides for side in pair))
        made_of = [materials.ALL_MATERIALS[material] for _, material in banks]
        self._bank_of_mode = np.repeat(np.arange(len(banks)), [len(m.frequencies) for m in made_of])
        self._pair_modes = [
            np.flatnonzero(np.isin(self._bank_of_mode, [banks.index(side) for side in pair])) for pair in sides
        ]
        self._frequencies = np.array([f for material in made_of for f in material.frequencies])
        self._decays = np.array([d for material in made_of for d in material.decays])
        # Each partner gives half the energy of a touch.
        loudness = _TOUCH_RMS * np.sqrt(_TOUCH_SECONDS / 2.0)
        self._amplitudes = loudness * np.array([a for material in made_of for a in material.amplitudes()])

    def _lay_out_samples(self) -> None:
        """Which samples lie in which physics step: a step need not hold a whole number of samples."""
        edges = np.arange(self.n_substeps + 1) * self.samples_per_step / self.n_substeps
        first = np.ceil(edges - 1e-9).astype(int)
        self._lead = (first - edges)[:-1] / self.sample_rate  # from a physics step to its first sample [s]
        self._longest = int(np.diff(first).max())
        sample = np.arange(self.samples_per_step)
        step = np.searchsorted(first, sample, side="right") - 1
        self._samples: np.ndarray | slice = step * self._longest + sample - first[step]
        if self.samples_per_step == self.n_substeps * self._longest:
            self._samples = slice(None)  # spares a copy

    def _tune_modes(self, rng: np.random.Generator) -> None:
        pitch = 1.0 + _PITCH_SPREAD * rng.uniform(-1.0, 1.0, len(self._bank_of_mode))[self._bank_of_mode]
        poles = -self._decays + 2j * np.pi * self._frequencies * pitch
        steps = np.arange(self.n_substeps)[:, None, None]
        self._power = np.exp(poles * self.physics_dt)
        self._powers = np.exp(poles * self.physics_dt * steps)  # (n_substeps, 1, n_modes)
        self._advance = np.exp(poles * self._lead[:, None, None])
        wave = np.exp(poles[:, None] * np.arange(self._longest) / self.sample_rate)
        wave[self._frequencies > 0.45 * self.sample_rate] = 0.0  # no sample rate can hold what lies above its half
        # A body that is struck starts as a sine, from rest: the imaginary part.
        self._table = np.concatenate([wave.imag, wave.real]).astype(np.float32)  # (2 n_modes, samples of a step)


def _path_gain(forces: np.ndarray, links: np.ndarray | None) -> np.ndarray | float:
    """Gain from a pair to a microphone: 1 through structure, and less through the air, per physics step."""
    if links is None:
        return 1.0
    return np.where((forces[:, links] > 0.0).any(axis=1, keepdims=True), 1.0, _AIR_GAIN)


def _pink_filter(sample_rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients that make white noise nearly pink, equally loud per hertz at every sample rate."""
    zeros, poles = -2 * np.pi * np.array([95.0, 950.0]), -2 * np.pi * np.array([30.0, 300.0, 3000.0])
    numerator, denominator = signal.zpk2tf(*signal.bilinear_zpk(zeros, poles, 1.0, sample_rate))
    band = np.linspace(0.0, _NOISE_BAND_HZ, 4001)
    power = np.mean(np.abs(signal.freqs_zpk(zeros, poles, 1.0, worN=2 * np.pi * band)[1]) ** 2)
    gain = _NOISE_RMS / np.sqrt(power * _NOISE_BAND_HZ / (0.5 * sample_rate))
    return (gain * numerator).astype(np.float32), denominator.astype(np.float32)


def _microphones(names: Sequence[str]) -> tuple[Microphone, ...]:
    if not names or len(set(names)) != len(names) or not all(name in materials.ALL_MICROPHONES for name in names):
        raise ValueError(
            f"microphones is {names!r}; name at least one of {sorted(materials.ALL_MICROPHONES)}, each only once."
        )
    return tuple(materials.ALL_MICROPHONES[name] for name in names)
