"""What can be heard and who listens: materials, pairs of bodies that touch, and microphones.

A struck body rings in its modes: damped sines whose frequencies and decays belong to material and shape, and
whose mix depends on where it was hit. This is modal synthesis (van den Doel, Kry and Pai, "FoleyAutomatic",
SIGGRAPH 2001). The numbers are our own choice, made so that materials are distinct below 4 kHz, the part of
the spectrum that the policy hears (paper, real-robot set-up: the lowest 160 bins of 25 Hz).
"""

from dataclasses import dataclass

import numpy as np

from gym_playbyear.plugins import Registry


@dataclass(frozen=True)
class Material:
    """The modes in which a body rings.

    Attributes:
        frequencies: Frequency of each mode [Hz].
        decays: Decay rate of each mode's amplitude [1/s]; it falls to 1/e in `1 / decay` seconds.
        gains: Relative amplitude of each mode. Only ratios count: equal blows are equally loud.
        loudness: Factor on all its sound.
    """

    frequencies: tuple[float, ...]
    decays: tuple[float, ...]
    gains: tuple[float, ...]
    loudness: float = 1.0

    def amplitudes(self) -> np.ndarray:
        """The gains, scaled so that the square of the whole ring, integrated over time, is `loudness` squared seconds."""
        gains = np.array(self.gains)
        # A damped sine of amplitude g and decay d has energy g^2 / 4d (for d far below its frequency).
        return self.loudness * (gains / np.sqrt(np.sum(gains**2 / (4.0 * np.array(self.decays)))))


MATERIALS: dict[str, Material] = {
    # Steel fingers: small and stiff, so high and clear.
    "gripper": Material((1980.0, 2870.0, 3720.0), (90.0, 110.0, 140.0), (1.0, 0.8, 0.6)),
    # Hollow wooden block: a knock with a pitch.
    "cube": Material((640.0, 1120.0, 1510.0, 2420.0), (90.0, 110.0, 140.0, 190.0), (1.0, 1.0, 0.7, 0.5)),
    # Large panel: low, and it rings longest.
    "wall": Material((115.0, 170.0, 235.0, 300.0), (45.0, 50.0, 60.0, 80.0), (0.7, 1.0, 0.8, 0.5)),
    # Thick wood: a dull thud between panel and block.
    "table": Material((380.0, 470.0, 800.0, 905.0), (130.0, 150.0, 180.0, 200.0), (1.0, 0.9, 0.5, 0.3)),
    # Thin plastic tray: a light, bright rattle.
    "bin": Material((870.0, 1320.0, 1740.0, 3300.0), (80.0, 100.0, 120.0, 170.0), (0.6, 0.8, 1.0, 0.7)),
    # What the cube can be made of instead, for testing what a policy makes of sounds that it has not heard.
    "glass": Material((1460.0, 2310.0, 3150.0, 3880.0), (40.0, 55.0, 70.0, 90.0), (1.0, 0.8, 0.6, 0.4)),
    "tin": Material(
        (850.0, 1370.0, 2050.0, 2760.0, 3480.0), (50.0, 60.0, 70.0, 90.0, 110.0), (0.7, 1.0, 0.9, 0.7, 0.5)
    ),
    "cardboard": Material((210.0, 340.0, 560.0), (220.0, 260.0, 320.0), (1.0, 0.8, 0.4)),
    "rubber": Material((90.0, 150.0, 260.0), (160.0, 200.0, 260.0), (1.0, 0.6, 0.3)),
}

CUBE_MATERIALS = ("cube", "glass", "tin", "cardboard", "rubber")

ALL_MATERIALS = Registry("materials", MATERIALS)
"""Ours, and those of other distributions (`gym_playbyear.plugins`)."""


@dataclass(frozen=True)
class ContactPair:
    """Two bodies whose contact can be heard.

    Attributes:
        name: What the pair is called, for messages.
        materials: Names in `MATERIALS` of what the two bodies are made of.
        bodies: The two bodies, such as `("gripper", "cube")`, in the same order.
        loose: Bodies that move freely. They carry sound to whatever they press against.
    """

    name: str
    materials: tuple[str, str]
    bodies: tuple[str, str]
    loose: frozenset[str] = frozenset({"cube"})

    def __post_init__(self) -> None:
        for material in self.materials:
            if material not in ALL_MATERIALS:
                raise ValueError(
                    f"Contact pair '{self.name}' names material '{material}'; known are {sorted(ALL_MATERIALS)}."
                )


@dataclass(frozen=True)
class Microphone:
    """A contact microphone.

    Attributes:
        name: What it is called in `MICROPHONES` and in observations.
        structure: Bodies whose contacts reach it through solid matter, the one that it is fixed to among them. A loose
            body joins them for as long as it presses against one of them.
        hum: Level of the arm's motors, as a factor on their level at the arm itself.
    """

    name: str
    structure: frozenset[str]
    hum: float

    def structure_borne(self, pairs: tuple[ContactPair, ...]) -> list[np.ndarray | None]:
        """Tells for each pair when its sound reaches this microphone through structure.

        Returns:
            For each pair None for always, or the indices of the pairs of which one has to press: those between
            the pair's loose body and this microphone's structure, perhaps none.
        """
        links: list[np.ndarray | None] = []
        for pair in pairs:
            if self.structure & {*pair.bodies}:
                links.append(None)
                continue
            loose = pair.loose & {*pair.bodies}
            touching = [loose & {*p.bodies} and self.structure & {*p.bodies} for p in pairs]
            links.append(np.flatnonzero([bool(touches) for touches in touching]))
        return links


MICROPHONES: dict[str, Microphone] = {
    "gripper": Microphone("gripper", frozenset({"gripper"}), 1.0),
    "table": Microphone("table", frozenset({"table", "wall", "bin"}), 0.3),
}

ALL_MICROPHONES = Registry("microphones", MICROPHONES)
"""Ours, and those of other distributions."""
