"""Blows: when two bodies hit, how hard, and for how long they touch.

Blows are found in speeds, not in forces: a simulator's contact is much softer than a real one, so that its forces rise over
several physics steps, and how fast depends on their size. The speed with which bodies meet does not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gym_playbyear.contact_kinematics import Contacts, SoundingPair
from gym_playbyear.materials_v2 import material
from gym_playbyear.sound_timing import Smoother

# Speeds below the first are solver jitter: silent; above the second all counts [m/s]. The second row is for bodies that touch
# already: another edge comes down.
_AUDIBLE_SPEED = (0.001, 0.004)
_AUDIBLE_JUMP = (0.01, 0.04)
_OPEN_SECONDS = 0.005  # a contact that was open for less did not open
# MuJoCo lets what slides hop, with up to friction times slip speed (its cones are relaxed so that contact stays convex). A body
# that comes down within the first [s] counts as still sliding, and only speed beyond the second, times slip speed, is a blow.
_HOP_SECONDS, _HOP_SPEED = 0.08, 0.6
_TIP_RADIUS = 0.005  # m: curvature where edges and corners touch (chosen)
_DURATION = (2e-5, 0.1)  # s
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

    def __init__(self, pairs: Sequence[SoundingPair], physics_dt: float, n_substeps: int) -> None:
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
    return np.clip(2.87 * (mass**2 / (_TIP_RADIUS * modulus**2 * speed)) ** 0.2, *_DURATION)


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


def _contact_modulus(pair: SoundingPair) -> float:
    substances = [material(name).substance for name in pair.materials]
    return 1.0 / sum((1.0 - substance.poisson**2) / substance.young for substance in substances)
