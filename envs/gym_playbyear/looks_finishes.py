"""Surfaces for the eye: wood, paper, cloth, paint, metal. Textures are computed, and tint whatever colour a thing has."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

_SIZE = 256  # pixels of a texture's side


@dataclass(frozen=True)
class Finish:
    """A surface.

    Attributes:
        specular, shininess: How much it shines, and how narrowly, in [0, 1].
        texture: `texture(rng)` gives grey values about 1, (size, size).
        repeat: How often the texture is repeated.
        is_flat: The texture is laid on from above, per metre; otherwise on each side of a box.
    """

    specular: float
    shininess: float
    texture: Callable[[np.random.Generator], np.ndarray] | None = None
    repeat: float = 1.0
    is_flat: bool = False


def _wood(rng: np.random.Generator) -> np.ndarray:
    """Planks, with grain along the first axis."""
    columns = np.arange(_SIZE) / _SIZE
    plank = np.floor(columns * 4).astype(int)
    grain = np.sin(2 * np.pi * (columns * 36 + 0.9 * _smooth(rng, 2))) * 0.02
    fibre = np.repeat(rng.normal(0.0, 0.025, (_SIZE // 16, _SIZE)), 16, axis=0)
    gap = np.minimum(columns * 4 % 1, 1 - columns * 4 % 1) < 0.012
    tone = np.array([0.0, -0.04, 0.03, -0.02])[plank]
    return 0.95 + grain + fibre + tone - 0.2 * gap


def _paper(rng: np.random.Generator) -> np.ndarray:
    """Brown paper: soft creases and fibres."""
    return 0.95 + 0.05 * _smooth(rng, 3) + rng.normal(0.0, 0.02, (_SIZE, _SIZE))


def _cloth(rng: np.random.Generator) -> np.ndarray:
    """A weave."""
    rows, columns = np.mgrid[0:_SIZE, 0:_SIZE]
    weave = np.where((rows // 4 + columns // 4) % 2, np.sin(rows * np.pi / 4), np.sin(columns * np.pi / 4))
    return 0.88 + 0.12 * np.abs(weave) + rng.normal(0.0, 0.02, (_SIZE, _SIZE))


def _smooth(rng: np.random.Generator, waves: int) -> np.ndarray:
    """Smooth noise that can be repeated, about in [-1, 1]."""
    rows, columns = np.mgrid[0:_SIZE, 0:_SIZE] * (2 * np.pi / _SIZE)
    total = np.zeros((_SIZE, _SIZE))
    for _ in range(4 * waves):
        up, right = rng.integers(-waves, waves + 1, 2)
        total += np.cos(up * rows + right * columns + rng.uniform(0, 2 * np.pi))
    return total / np.abs(total).max()


FINISHES: dict[str, Finish] = {
    "wood": Finish(0.15, 0.3, _wood, repeat=2.5, is_flat=True),
    "paper": Finish(0.05, 0.1, _paper),
    "cloth": Finish(0.02, 0.1, _cloth, repeat=2.0),
    "floor": Finish(0.1, 0.2),
    "paint": Finish(0.35, 0.5),
    "plastic": Finish(0.45, 0.6),
    "metal": Finish(0.9, 0.8),
    "rubber": Finish(0.1, 0.2),
}

_OF_MATERIALS = {
    **dict.fromkeys(("table", "wood"), "wood"),
    **dict.fromkeys(("bag", "cardboard"), "paper"),
    **dict.fromkeys(("pouch", "cloth", "sponge"), "cloth"),
    **dict.fromkeys(("keys", "screws", "tin", "glass"), "metal"),
    **dict.fromkeys(("rubber", "peanuts"), "rubber"),
    "wall": "paint",
}


def finish_of(material: str | None) -> str:
    """The surface of what sounds like `material`."""
    return _OF_MATERIALS.get(material or "", "plastic")


def add_finishes(spec: mujoco.MjSpec) -> None:
    """Adds all surfaces to a scene, as materials of the same names."""
    for name, finish in FINISHES.items():
        material = spec.add_material(name=name, specular=finish.specular, shininess=finish.shininess)
        if finish.texture is None:
            continue
        grey = np.clip(finish.texture(np.random.default_rng(1)) * 255, 0, 255).astype(np.uint8)
        pixels = np.repeat(grey[..., None], 3, axis=-1)
        kind = mujoco.mjtTexture.mjTEXTURE_2D
        if not finish.is_flat:
            kind, pixels = mujoco.mjtTexture.mjTEXTURE_CUBE, np.concatenate([pixels] * 6)
        texture = spec.add_texture(name=name, type=kind, width=_SIZE, height=len(pixels), nchannel=3)
        texture.data = pixels.tobytes()
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.texuniform, material.texrepeat = finish.is_flat, [finish.repeat] * 2
