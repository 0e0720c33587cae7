"""Bags crackle when they bend: clicks at random, more the faster they bend, and each of its own strength.

The clicks' energies follow a power law, as those of crumpled paper do (Houle and Sethna, "Acoustic emission from crumpling
paper", Phys. Rev. E 1996: exponents of 1.3 to 1.6). Rates and the range of strengths are our own choice.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from gym_playbyear.materials import CRACKLE, ContactPair

_POWER = 1.45
_FORCES = (20.0, 2000.0)  # N: steps of force that the faintest and the loudest click are like, heard through the air


class Crackle:
    """Clicks, as steps of a force that each body that crackles exerts on itself.

    Args:
        sides: Body and material of all that can be heard.

    Attributes:
        pairs: One for each body that crackles; the columns of what `step` returns.
    """

    def __init__(self, sides: Sequence[tuple[str, str]]):
        crackling = [side for side in dict.fromkeys(sides) if side[1] in CRACKLE]
        self.pairs = [ContactPair(f"{body} bends", (made_of,) * 2, (body,) * 2) for body, made_of in crackling]
        self._rates = {body: CRACKLE[made_of] for body, made_of in crackling}

    def reset(self, rng: np.random.Generator) -> None:
        """An episode begins; its clicks are drawn from a stream of `rng`."""
        if self.pairs:
            (self._rng,) = rng.spawn(1)
            self._level = np.zeros(len(self.pairs))

    def step(self, speeds: Mapping[str, np.ndarray], n_substeps: int, physics_dt: float) -> np.ndarray:
        """Forces (n_substeps, n_pairs) [N], which jump at every click.

        Args:
            speeds: Of the bending of each body (n_substeps,) [rad/s]; one that is missing does not bend.
            n_substeps: Physics steps of the control step.
            physics_dt: Their duration [s].
        """
        forces = np.empty((n_substeps, len(self.pairs)))
        for column, (body, rate) in enumerate(self._rates.items()):
            clicks = self._rng.random(n_substeps) < rate * physics_dt * speeds.get(body, np.zeros(n_substeps))
            low, high = (limit ** (1.0 - _POWER) for limit in _FORCES)
            strengths = (low + self._rng.random(n_substeps) * (high - low)) ** (1.0 / (1.0 - _POWER))
            # Steps up and down by turns of chance: the level does not matter, only that it changes.
            signs = np.where(self._rng.random(n_substeps) < 0.5, -1.0, 1.0)
            forces[:, column] = self._level[column] + np.cumsum(clicks * strengths * signs)
            self._level[column] = forces[-1, column]
        return forces
