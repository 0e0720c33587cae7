"""Bags crackle when they bend: clicks at random, more the faster they bend, and each of its own strength.

Energies of the clicks of crumpled paper follow a power law, p(E) ~ E^-a with a = 1.3 to 1.6, over several decades (Houle and
Sethna, "Acoustic emission from crumpling paper", Phys. Rev. E 1996); their rate is chosen (`Material.crackle`).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from gym_playbyear.contact_kinematics import SoundingPair
from gym_playbyear.materials_v2 import material
from gym_playbyear.sound_v2_blows import Blows

_POWER = 1.45
_ENERGIES = 1000.0  # of the loudest click over the faintest
_FAINTEST = 2e-4  # Ns: impulse that the faintest click is like (chosen)
_DURATION = 1e-4  # s
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

    def __init__(self, pairs: Sequence[SoundingPair], physics_dt: float) -> None:
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
        return Blows(step, source, self._impulses(len(step)), np.full(len(step), _DURATION))

    def positions(self, bending: Mapping[str, Bending], n_substeps: int) -> np.ndarray:
        """(n_substeps, n_bodies, 3) [m]; zero for what does not bend."""
        places = [bending[body].position if body in bending else np.zeros(3) for body in self.bodies]
        return np.broadcast_to(np.array(places), (n_substeps, len(places), 3))

    def _impulses(self, count: int) -> np.ndarray:
        """(count,) [Ns], whose squares, the energies, follow the power law."""
        rest = 1.0 - _POWER
        energy = (1.0 + self._rng.uniform(size=count) * (_ENERGIES**rest - 1.0)) ** (1.0 / rest)
        return _FAINTEST * np.sqrt(energy)
