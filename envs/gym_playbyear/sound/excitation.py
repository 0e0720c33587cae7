"""What makes things sound: blows, friction, and bags that crackle when they bend."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import signal

from gym_playbyear.contacts import ContactPair, Contacts
from gym_playbyear.sound.materials import material


class Smoother:
    """A running mean that forgets exponentially, over control steps of `n_substeps` physics steps, for all columns at once."""

    def __init__(self, n_substeps: int, physics_dt: float, seconds: float) -> None:
        age = np.subtract.outer(np.arange(n_substeps), np.arange(n_substeps))
        forget = np.exp(-physics_dt / seconds)
        self._kernel = np.where(age >= 0, (1.0 - forget) * forget ** np.maximum(age, 0), 0.0)
        self._fade = forget ** np.arange(1, n_substeps + 1)[:, None]

    def reset(self, value: np.ndarray) -> None:
        """`value`: what the mean has been so far, (n,)."""
        self.value = np.array(value, float)

    def next(self, values: np.ndarray) -> np.ndarray:
        """The means at every physics step of a control step, (n_substeps, n), of its `values` and all earlier ones."""
        means = self._kernel @ values + self._fade * self.value
        self.value = means[-1].copy()
        return means


# Speeds below the first are solver jitter: silent; above the second all counts [m/s]. The second row is for bodies that touch
# already: another edge comes down.
_AUDIBLE_SPEED = (0.001, 0.004)
_AUDIBLE_JUMP = (0.01, 0.04)
_OPEN_SECONDS = 0.005  # a contact that was open for less did not open
# MuJoCo lets what slides hop, with up to friction times slip speed (its cones are relaxed so that contact stays convex). A body
# that comes down within the first [s] counts as still sliding, and only speed beyond the second, times slip speed, is a blow.
_HOP_SECONDS, _HOP_SPEED = 0.08, 0.6
_TIP_RADIUS = 0.005  # m: curvature where edges and corners touch (chosen)
_LONGEST_SHORTEST = (2e-5, 0.1)  # s
_SHAPES = np.array([0.7, 0.85, 1.0, 1.15, 1.3])
_RELEASE = 4e-5  # s: force that a contact held, times this, is the blow of its end: a grip that lets go clicks (chosen)
_RELEASE_FORCE = (0.5, 2.0)  # N: less is silent, all counts above
_RELEASE_DURATION = 0.001  # s
_STICKING_SPEED = 0.01  # m/s: what slides faster lets go of nothing
_MEMORY = 0.02  # s, of the force that a contact held


class Blows(NamedTuple):
    """step: physics step, (n,). pair: index, (n,). impulse: (n,) [Ns]. duration: of contact, (n,) [s]."""

    step: np.ndarray
    pair: np.ndarray
    impulse: np.ndarray
    duration: np.ndarray


class BlowFinder:
    """Finds blows in the contacts of one control step after the other.

    Args:
        pairs: As in `Contacts`.
        physics_dt: [s].
        n_substeps: Physics steps in a control step.
    """

    def __init__(self, pairs: Sequence[ContactPair], physics_dt: float, n_substeps: int) -> None:
        self._stiffness = np.array([_contact_modulus(pair) for pair in pairs])
        self._open_steps = max(1, round(_OPEN_SECONDS / physics_dt))
        self._hop_steps = max(self._open_steps, round(_HOP_SECONDS / physics_dt))
        self._held = Smoother(n_substeps, physics_dt, _MEMORY)
        self._steps = np.arange(1, n_substeps + 1)[:, None]

    def reset(self, stiffness: np.ndarray) -> None:
        """Starts an episode; `stiffness`: factor for each pair. What touches already makes no blow."""
        self._moduli = self._stiffness * stiffness
        self._since = np.full(len(stiffness), self._hop_steps + 1)  # physics steps since each pair touched
        self._approach = np.zeros(len(stiffness))  # of the last step
        self._held.reset(np.zeros(len(stiffness)))
        self._is_first = True

    def find(self, contacts: Contacts) -> Blows | None:
        """The blows of a control step, in the order of time."""
        force = contacts.normal_force
        touching = force > 0.0
        if self._is_first:  # what touches now did so before, and moved as it does
            self._since[touching[0]] = 0
            self._approach = contacts.approach_speed[0] * touching[0]
            self._held.reset(force[0])
            self._is_first = False
        if not touching.any() and self._since.min() > self._open_steps:
            self._held.value[:] = 0.0
            return None
        held = self._held.next(force * (contacts.slip_speed < _STICKING_SPEED))
        approach = np.maximum(contacts.approach_speed, 0.0)
        rise = approach.copy()
        rise[1:] -= approach[:-1]
        rise[0] -= self._approach
        self._approach = approach[-1]
        open_for = self._open_for(touching)
        new = touching & (open_for >= self._open_steps)
        end = ~touching & (open_for == self._open_steps - 1)
        step, pair = np.nonzero(end | (touching & (rise > _AUDIBLE_SPEED[0])))
        if not len(step):
            return None
        new, end = new[step, pair], end[step, pair]
        hop = _HOP_SPEED * contacts.slip_speed[step, pair] * (open_for[step, pair] <= self._hop_steps)
        speed, jump = (np.maximum(each[step, pair] - hop, 0.0) for each in (approach, rise))
        speed = np.where(new, speed * smooth_step(speed, _AUDIBLE_SPEED), jump * smooth_step(jump, _AUDIBLE_JUMP))
        lost = held[step, pair]
        impulse = np.where(end, _RELEASE * lost * smooth_step(lost, _RELEASE_FORCE), contacts.mass[pair] * speed)
        heard = impulse > 0.0
        if not heard.any():
            return None
        duration = hertz_duration(contacts.mass[pair], self._moduli[pair], np.maximum(speed, _AUDIBLE_SPEED[0]))
        return Blows(*(each[heard] for each in (step, pair, impulse, np.where(end, _RELEASE_DURATION, duration))))

    def _open_for(self, touching: np.ndarray) -> np.ndarray:
        """How many physics steps each contact was open before each step, (n_substeps, n_pairs)."""
        last = np.maximum.accumulate(np.where(touching, self._steps, -self._since), axis=0)  # step of the last touch
        open_for = np.empty_like(last)
        open_for[0] = self._since
        open_for[1:] = self._steps[:-1] - last[:-1]
        self._since = np.minimum(len(touching) - last[-1], self._hop_steps + 1)
        return open_for


def hertz_duration(mass, modulus, speed):
    """How long two bodies touch when they collide [s]: Hertz (Johnson, "Contact Mechanics", 11.4).

    Args:
        mass: Reduced mass [kg].
        modulus: Contact modulus of both substances [Pa].
        speed: Of approach [m/s].
    """
    return np.clip(2.87 * (mass**2 / (_TIP_RADIUS * modulus**2 * speed)) ** 0.2, *_LONGEST_SHORTEST)


def pulse_spectrum(frequency, duration):
    """Magnitude of the spectrum of a half-sine pulse of impulse 1: 1 for low frequencies, dull for long pulses.

    A half sine has zeros; real contacts are never quite symmetric and have dips instead: the mean over some durations.

    Args:
        frequency: [Hz], of any shape that goes with that of `duration`, [s].
    """
    x = 2.0 * np.multiply.outer(_SHAPES, frequency * duration)
    gap = 1.0 - x * x
    near = np.abs(gap) < 1e-3
    pulse = np.where(near, 0.25 * np.pi, np.cos(0.5 * np.pi * x) / np.where(near, 1.0, gap))
    return np.sqrt(np.mean(pulse * pulse, axis=0))


def smooth_step(value, limits: tuple[float, float]):
    """0 below the limits, 1 above them, and smooth between."""
    x = np.minimum(np.maximum((value - limits[0]) / (limits[1] - limits[0]), 0.0), 1.0)  # faster than np.clip
    return x * x * (3.0 - 2.0 * x)


def _contact_modulus(pair: ContactPair) -> float:
    substances = [material(name).substance for name in pair.materials]
    return 1.0 / sum((1.0 - substance.poisson**2) / substance.young for substance in substances)


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
        self, pairs: Sequence[ContactPair], physics_dt: float, n_substeps: int, sample_rate: int, n_ears: int
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


_POWER = 1.45
_ENERGIES = 1000.0  # of the loudest click over the faintest
_FAINTEST = 2e-4  # Ns: impulse that the faintest click is like (chosen)
_CLICK = 1e-4  # s
_MOST = 64  # clicks in a control step: more are one noise


class Bending(NamedTuple):
    """How a body bends: speed at every physics step, (n_substeps,) [rad/s], at least 0; and where it is, (3,) [m, world]."""

    speed: np.ndarray
    position: np.ndarray


class Crackle:
    """Clicks of all bodies whose material crackles.

    Attributes:
        sides: Body and material of each.
        bodies: Names of those bodies.
    """

    def __init__(self, pairs: Sequence[ContactPair], physics_dt: float) -> None:
        self._dt, self._n_pairs = physics_dt, len(pairs)
        sides = [side for pair in pairs for side in zip(pair.bodies, pair.materials, strict=True)]
        self.sides = [side for side in dict.fromkeys(sides) if material(side[1]).crackle > 0.0]
        self.bodies = [body for body, _ in self.sides]
        self._rates = [material(name).crackle for _, name in self.sides]

    def reset(self, rng: np.random.Generator) -> None:
        """Starts an episode whose clicks come from `rng`."""
        self._rng = rng

    def find(self, bending: Mapping[str, Bending]) -> Blows | None:
        """The clicks of a control step, as blows of sources that follow the pairs.

        Raises:
            ValueError: If a body bends that does not crackle.
        """
        if not bending:
            return None
        unknown = sorted(set(bending) - set(self.bodies))
        if unknown:
            raise ValueError(
                f"bending names {', '.join(unknown)}; bodies that crackle: {', '.join(self.bodies) or 'none'}."
            )
        steps, sources = [], []
        for index, (body, rate) in enumerate(zip(self.bodies, self._rates, strict=True)):
            if body in bending:
                clicks = self._rng.poisson(rate * self._dt * np.maximum(bending[body].speed, 0.0))
                steps.append(np.repeat(np.arange(len(clicks)), clicks)[:_MOST])
                sources.append(np.full(len(steps[-1]), self._n_pairs + index))
        step, source = np.concatenate(steps), np.concatenate(sources)
        if not len(step):
            return None
        return Blows(step, source, self._impulses(len(step)), np.full(len(step), _CLICK))

    def positions(self, bending: Mapping[str, Bending], n_substeps: int) -> np.ndarray:
        """(n_substeps, n_bodies, 3) [m]; zero for what does not bend."""
        places = [bending[body].position if body in bending else np.zeros(3) for body in self.bodies]
        return np.broadcast_to(np.array(places), (n_substeps, len(places), 3))

    def _impulses(self, count: int) -> np.ndarray:
        """(count,) [Ns], whose squares, the energies, follow the power law."""
        rest = 1.0 - _POWER
        energy = (1.0 + self._rng.uniform(size=count) * (_ENERGIES**rest - 1.0)) ** (1.0 / rest)
        return _FAINTEST * np.sqrt(energy)
