"""What things sound like: modes of real shapes and substances, contact stiffness, roughness.

A struck body rings in its modes: damped sines (modal synthesis: van den Doel, Kry and Pai, "FoleyAutomatic", SIGGRAPH 2001).

- Frequencies of plates, bars, cups and rings are those of thin elastic shapes (Fletcher and Rossing, "The Physics of Musical
  Instruments", chapters 2 and 3; for cups Rayleigh's rings that bend without stretching).
- Stiffness, density and damping of substances marked with * are table 4 of Wang and James, "KleinPAT" (SIGGRAPH 2019), which
  RealImpact (CVPR 2023) compares its recordings with: a mode of angular frequency w decays with (alpha + beta w^2) / 2. The
  others' are engineering values.
- Damping by supports, that of plastic, cardboard and of what is made with `chosen` are set so that the median mode rings, in
  every episode, between the 10th and the 90th percentile of the modes that Traer et al. measured (DAFx 2019):
  `tools/decay_times.py`.
  They measured no film; it rings like paper.
- Sizes, roughness and loudness are chosen; so are the frequencies of what is made with `chosen`.
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.registry import Registry


@dataclass(frozen=True)
class Substance:
    """density [kg/m3], Young's modulus [Pa], Poisson's ratio, Rayleigh damping alpha [1/s] and beta [s]."""

    density: float
    young: float
    poisson: float
    alpha: float
    beta: float

    @property
    def wave_speed(self) -> float:
        """Of compression along a thin bar [m/s]."""
        return float(np.sqrt(self.young / self.density))


GLASS = Substance(2600, 6.2e10, 0.20, 1, 1e-7)  # *
WOOD = Substance(750, 1.1e10, 0.25, 60, 2e-6)  # *
PLASTIC = Substance(1070, 1.4e9, 0.35, 30, 2e-7)  # *; beta is a fifth of theirs, so that the cube rings long enough
POLYCARBONATE = Substance(1190, 2.4e9, 0.37, 0.5, 4e-7)  # *
STEEL = Substance(7850, 2.0e11, 0.29, 5, 3e-8)  # *
BRASS = Substance(8500, 1.0e11, 0.34, 5, 3e-8)
ALUMINIUM = Substance(2700, 6.9e10, 0.33, 5, 3e-8)
TINPLATE = Substance(7850, 2.0e11, 0.29, 20, 1e-7)
CARDBOARD = Substance(700, 2.0e9, 0.30, 100, 2e-7)
RUBBER = Substance(1100, 5.0e6, 0.49, 300, 1e-5)
FOAM = Substance(20, 1.0e6, 0.30, 500, 1e-5)
CLOTH = Substance(300, 1.0e5, 0.30, 800, 1e-5)
FILM = Substance(950, 2.0e8, 0.40, 300, 2e-6)


@dataclass(frozen=True)
class Material:
    """What a body sounds like.

    Attributes:
        substance: Of the surface that touches: decides how long a contact lasts.
        frequencies: Of the modes [Hz].
        decays: Rate at which each mode's amplitude decays [1/s].
        loudness: Factor on all its sound; 1 is a hard, resonant thing.
        roughness: Distance between asperities [m]: slip speed over it is where friction noise is strongest.
        crackle: Clicks per radian of bending; 0 for what does not crackle.
    """

    substance: Substance
    frequencies: tuple[float, ...]
    decays: tuple[float, ...]
    loudness: float = 1.0
    roughness: float = 1e-4
    crackle: float = 0.0

    def amplitudes(self) -> np.ndarray:
        """Equal for all modes, so that the square of the whole ring, integrated over time, is `loudness` squared seconds."""
        # A damped sine of amplitude g and decay d has energy g^2 / 4d (for d far below its frequency).
        return np.full(len(self.decays), self.loudness / np.sqrt(np.sum(1.0 / (4.0 * np.array(self.decays)))))


def plate(substance: Substance, sides: tuple[float, float], thickness: float, modes: str) -> tuple[float, ...]:
    """Bending modes of a plate supported at its edges [Hz].

    Args:
        substance: What it is made of.
        sides: Of the plate [m].
        thickness: [m]
        modes: Half waves along each side, two digits a mode, a for 10, b for 11 and so on, with spaces between
            the modes: "11 2b".

    Raises:
        ValueError: `modes` is written otherwise.
    """
    wrong = [mode for mode in str(modes).split() or [""] if len(mode) != 2 or not mode.isalnum() or "0" in mode]
    if wrong:
        raise ValueError(
            f"modes={modes!r}: {wrong[0]!r} is not a mode. Write two digits for each, half waves along each side, a for 10, "
            "spaces between the modes, such as '11 12 2b'."
        )
    stiffness = substance.young / (12.0 * substance.density * (1.0 - substance.poisson**2))
    waves = [(int(mode[0], 36) / sides[0]) ** 2 + (int(mode[1], 36) / sides[1]) ** 2 for mode in modes.split()]
    return tuple(float(0.5 * np.pi * thickness * np.sqrt(stiffness) * wave) for wave in waves)


def bar(
    substance: Substance, length: float, gyration: float, modes: int, *, clamped: bool = False
) -> tuple[float, ...]:
    """Bending modes of a bar, free or clamped at one end [Hz]. Radius of gyration [m]: thickness / 3.46, rod diameter / 4."""
    roots = (1.8751, 4.6941, 7.8548) if clamped else (4.7300, 7.8532, 10.9956, 14.1372)
    scale = gyration * substance.wave_speed / (2.0 * np.pi * length**2)
    return tuple(float(root**2 * scale) for root in roots[:modes])


def cup(substance: Substance, radius: float, thickness: float, waves: tuple[int, ...]) -> tuple[float, ...]:
    """Modes in which the rim of a cup, can or ring bends, by waves around it [Hz]."""
    n = np.array(waves, float)
    shape = n * (n**2 - 1) / np.sqrt(n**2 + 1)
    return tuple(float(f) for f in shape * thickness * substance.wave_speed / (2 * np.pi * np.sqrt(12) * radius**2))


def ringing(substance: Substance, frequencies: tuple[float, ...], support: float, **more: float) -> Material:
    """A real shape. `support`: decay that holding or lying on something adds [1/s]; `more` of `Material`."""
    w = 2.0 * np.pi * np.array(frequencies)
    decays = 0.5 * (substance.alpha + substance.beta * w**2) + support
    return Material(substance, frequencies, tuple(float(d) for d in decays), **more)


def chosen(substance: Substance, frequencies: tuple[float, ...], decay: float, **more: float) -> Material:
    """Something without a pitch: modes where it is loud, all with the same short decay [1/s]; `more` of `Material`."""
    return Material(substance, frequencies, (decay,) * len(frequencies), **more)


_MM = 1e-3
_FINGER = bar(STEEL, 75 * _MM, 10 * _MM / 12**0.5, 2, clamped=True) + bar(
    STEEL, 75 * _MM, 20 * _MM / 12**0.5, 1, clamped=True
)
_KEYS = bar(BRASS, 55 * _MM, 2 * _MM / 12**0.5, 2) + bar(BRASS, 45 * _MM, 2.2 * _MM / 12**0.5, 1)

MATERIALS: dict[str, Material] = {
    # Steel fingers, 10 x 20 mm, 75 mm with their carriage, in a hand with a cover of 200 x 63 x 4 mm aluminium.
    "gripper": ringing(STEEL, _FINGER + plate(ALUMINIUM, (0.2, 0.063), 4 * _MM, "11 21"), 60, roughness=6e-5),
    # Hollow box of hard plastic, walls of 40 x 40 x 1.5 mm.
    "cube": ringing(PLASTIC, plate(PLASTIC, (0.04, 0.04), 1.5 * _MM, "11 12 22 13 23"), 70, roughness=1.2e-4),
    # Steel sheet, 800 x 600 x 3 mm: some of its many modes, spread over what is heard. What rings shorter holds less energy.
    "wall": ringing(STEEL, plate(STEEL, (0.8, 0.6), 3 * _MM, "22 42 44 65 97 b9 db"), 50, loudness=0.7, roughness=8e-5),
    # Wood, 800 x 800 x 40 mm.
    "table": ringing(WOOD, plate(WOOD, (0.8, 0.8), 40 * _MM, "11 12 22 13 23 24"), 20, roughness=2.5e-4),
    # Plastic tray, 80 x 80 x 2 mm.
    "tray": ringing(PLASTIC, plate(PLASTIC, (0.08, 0.08), 2 * _MM, "11 12 22 13 23 33"), 125, roughness=1.5e-4),
    # What the cube can be made of instead: a tumbler, a can, a box, a block.
    "glass": ringing(GLASS, cup(GLASS, 35 * _MM, 1.5 * _MM, (2, 3, 4, 5)), 40, roughness=5e-5),
    "tin": ringing(TINPLATE, cup(TINPLATE, 35 * _MM, 0.25 * _MM, (4, 6, 8, 9, 10)), 30, roughness=8e-5),
    "cardboard": ringing(CARDBOARD, plate(CARDBOARD, (0.04, 0.04), 0.8 * _MM, "11 12 22 13"), 35, loudness=0.5),
    "rubber": chosen(RUBBER, (90.0, 150.0, 260.0), 115, loudness=0.5, roughness=4e-4),
    # Screws of 5 x 80 and 5 x 60 mm; three keys of 2 mm brass on a steel ring of 30 mm.
    "screws": ringing(STEEL, bar(STEEL, 80 * _MM, 1.25 * _MM, 2) + bar(STEEL, 60 * _MM, 1.25 * _MM, 1), 60, roughness=2e-4),
    "keys": ringing(BRASS, _KEYS + cup(STEEL, 15 * _MM, 3**0.5 * _MM, (2,)), 40, roughness=8e-5),
    # Pill bottle of 40 x 1.2 mm, pens (tubes of 8 and 6 mm, 140 mm long), wrapped sweets.
    "bottle": ringing(PLASTIC, cup(PLASTIC, 20 * _MM, 1.2 * _MM, (2, 3, 4, 5)), 120, roughness=1e-4),
    "pens": ringing(POLYCARBONATE, bar(POLYCARBONATE, 140 * _MM, 2.5 * _MM, 4), 90, loudness=0.8, roughness=1e-4),
    "candies": chosen(PLASTIC, (1900.0, 2750.0, 3600.0, 5200.0), 170, loudness=0.6, roughness=1.5e-4, crackle=25),
    # Packing peanuts: light foam, almost without a sound of its own.
    "peanuts": chosen(FOAM, (350.0, 620.0, 1100.0), 145, loudness=0.12, roughness=6e-4),
    # Bags that crackle.
    "pouch": chosen(FILM, (500.0, 900.0, 1600.0, 2600.0), 280, loudness=0.25, roughness=3e-4, crackle=15),
    "bag": chosen(FILM, (800.0, 1500.0, 2600.0, 4300.0, 6900.0), 280, loudness=0.4, roughness=2.5e-4, crackle=40),
    "chips": chosen(FILM, (1100.0, 2000.0, 3300.0, 5400.0), 280, loudness=0.5, roughness=2e-4, crackle=60),
    # Nearly mute.
    "cloth": chosen(CLOTH, (150.0, 300.0, 600.0), 153, loudness=0.05, roughness=8e-4),
    "sponge": chosen(CLOTH, (120.0, 220.0, 400.0), 145, loudness=0.05, roughness=1e-3),
}  # fmt: skip


ALL_MATERIALS = Registry("materials", MATERIALS)
"""Ours, and those of other distributions (`gym_playbyear.registry`)."""


def material(name: str) -> Material:
    """The material of that name.

    Raises:
        ValueError: If there is none, or another distribution's is no `Material`.
        PluginError: Another distribution's cannot be loaded.
    """
    return ALL_MATERIALS.checked(name, Material)
