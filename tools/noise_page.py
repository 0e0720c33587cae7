"""A picture and a film of the noise that training generates: each kind, first as it is, then in a room.

    python tools/noise_page.py --output=docs/media/noise

writes `kinds.png`, the spectrograms up to 8 kHz, and `kinds.mp4`, in which they are heard one after the other.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn import functional

from lerobot_playbyear.film.video import amplify, spectrogram_strip, write_film
from lerobot_playbyear.policy.generated_noise import STREAMS, STRUCK, GeneratedNoise, rooms

_RATE, _SECONDS, _FPS = 16000, 1.2, 5
_SEED = 11
_WIDTH, _HEIGHT = 320, 120  # pixels of a spectrogram
_QUALITY = {"crf": "38", "preset": "slow"}


def clips() -> dict[str, np.ndarray]:
    """Each kind as it is and then in a room, (n, 1) int16."""
    torch.manual_seed(_SEED)
    generated, n_bins = GeneratedNoise(), int(_SECONDS * _RATE / 2)
    spectra = {kind: generated.struck(torch.tensor([i]), _SECONDS, n_bins)[0] for i, kind in enumerate(STRUCK)}
    spectra |= {kind: generated.stream(kind, _SECONDS, n_bins) for kind in STREAMS}
    made = {}
    for kind, spectrum in spectra.items():
        room = rooms(1, _SECONDS, n_bins, spectrum.device)[0, 0]
        made[kind] = np.concatenate([_wave(spectrum), _wave(spectrum * room)])[:, None]
    return made


def _wave(spectrum: Tensor) -> np.ndarray:
    wave = torch.fft.irfft(functional.pad(spectrum, (1, 0)), norm="forward").numpy()
    return amplify((1000 * wave).astype(np.int16))


def picture(sounds: dict[str, np.ndarray]) -> Image.Image:
    """All spectrograms, two beside each other."""
    page = Image.new("RGB", (2 * _WIDTH, _HEIGHT * ((len(sounds) + 1) // 2)))
    for index, (kind, sound) in enumerate(sounds.items()):
        strip = Image.fromarray(spectrogram_strip(sound[:, 0], _RATE, _WIDTH, _HEIGHT))
        ImageDraw.Draw(strip).text((6, 4), f"{kind} | in a room", fill=(255, 255, 255))
        page.paste(strip, _corner(index))
    return page


def frames(page: Image.Image, n_kinds: int) -> Iterator[np.ndarray]:
    """The picture with a cursor where the sound is."""
    n = int(2 * _SECONDS * _FPS)
    for index in range(n_kinds):
        left, top = _corner(index)
        for frame in range(n):
            marked, x = page.copy(), left + int(_WIDTH * frame / n)
            ImageDraw.Draw(marked).line((x, top, x, top + _HEIGHT), fill=(255, 255, 255), width=2)
            yield np.asarray(marked)


def _corner(index: int) -> tuple[int, int]:
    return index % 2 * _WIDTH, index // 2 * _HEIGHT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/media/noise"))
    output: Path = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    sounds = clips()
    page = picture(sounds)
    page.quantize(16).save(output / "kinds.png")
    write_film(
        output / "kinds.mp4", frames(page, len(sounds)), _FPS, np.concatenate([*sounds.values()]), _RATE, _QUALITY
    )


if __name__ == "__main__":
    main()
