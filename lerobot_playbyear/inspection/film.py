"""An episode as a film with sound in memory, in the formats that every browser plays: H.264 and AAC."""

import itertools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import av
import numpy as np
from PIL import Image

from lerobot_playbyear.video import audio_frame, episode_sound, write_film

_AAC_RATES = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)
_NOT_READ = 96  # grey level of a picture that could not be read
_EMPTY_SIZE = 16  # pixels; the picture of an episode without cameras, which the page hides


def tile(
    pictures: Mapping[str, Iterator[np.ndarray]], n_frames: int, height: int
) -> tuple[list[int], Iterator[np.ndarray]]:
    """Puts the pictures of all cameras beside each other.

    Args:
        pictures: For each camera its n pictures (H, W, 3) uint8; one that ends early is grey from there on.
        n_frames: n.
        height: Of the tiles [pixels], at most; small pictures are enlarged by a whole factor.

    Returns:
        The width of each camera's tile [pixels], and the n tiled pictures (height, sum of widths, 3) uint8.
    """
    if not pictures:
        blank = np.zeros((_EMPTY_SIZE, _EMPTY_SIZE, 3), np.uint8)
        return [], itertools.repeat(blank, n_frames)
    first = {camera: next(stream, None) for camera, stream in pictures.items()}
    shapes = [picture.shape[:2] if picture is not None else (1, 1) for picture in first.values()]
    tallest = max(_fitted(shape[0], height) for shape in shapes)
    sizes = [(_even(shape[1] * tallest / shape[0]), tallest) for shape in shapes]

    def frames() -> Iterator[np.ndarray]:
        for index in range(n_frames):
            shown = [first[camera] if index == 0 else next(stream, None) for camera, stream in pictures.items()]
            yield np.concatenate([_resize(*pair) for pair in zip(shown, sizes, strict=True)], axis=1)
        for stream in pictures.values():
            next(stream, None)  # lets the streams come to their end

    return [width for width, _ in sizes], frames()


def encode(pictures: Iterator[np.ndarray], fps: int, sound: Sequence[np.ndarray], gain: float) -> bytes:
    """An mp4 with the sound of the first two microphones, left and right, in time with the pictures.

    Args:
        pictures: n pictures (H, W, 3) uint8, H and W even.
        fps: Frames per second [Hz].
        sound: For each microphone its (n, S) blocks in steps of 16-bit PCM; the block of frame t was heard before its
            picture was taken.
        gain: By how much to amplify.
    """
    blocks = [np.clip(block * gain, -32768, 32767).astype(np.int16) for block in sound[:2]]
    n_samples = {block.shape[1] for block in blocks}
    stacked = (
        np.stack(blocks if len(n_samples) == 1 else blocks[:1], axis=-1) if blocks else np.zeros((1, 0, 0), np.int16)
    )
    samples, sample_rate = at_a_rate_of_aac(episode_sound(stacked), stacked.shape[1] * fps)
    with tempfile.TemporaryDirectory() as folder:
        # Key frames every second, so that stepping backwards is quick.
        path = write_film(Path(folder) / "film.mp4", pictures, fps, samples, sample_rate, {"crf": "23", "g": str(fps)})
        return path.read_bytes()


def at_a_rate_of_aac(samples: np.ndarray, sample_rate: int) -> tuple[np.ndarray, int]:
    """Resamples (n, at most 2 channels) int16 to the next higher rate that AAC has, where that is necessary."""
    if samples.shape[1] == 0 or sample_rate in _AAC_RATES:
        return samples, sample_rate or _AAC_RATES[-1]
    rate = next((rate for rate in _AAC_RATES if rate > sample_rate), _AAC_RATES[-1])
    n_channels = samples.shape[1]
    # FFmpeg's: torchaudio's filter for rates with no common divisor takes gigabytes.
    resampler = av.AudioResampler(format="s16", layout=("mono", "stereo")[n_channels - 1], rate=rate)
    parts: list[np.ndarray] = []
    for first in range(0, len(samples) + sample_rate, sample_rate):
        part = samples[first : first + sample_rate]
        frames = resampler.resample(audio_frame(part, sample_rate, first) if len(part) else None)
        parts.extend(frame.to_ndarray().reshape(-1, n_channels) for frame in frames)
        if not len(part):
            break
    return np.concatenate(parts), rate


def _fitted(size: int, limit: int) -> int:
    return _even(size * max(limit // size, 1) if size <= limit else limit)


def _even(size: float) -> int:
    return max(2 * round(size / 2), 2)


def _resize(picture: np.ndarray | None, size: tuple[int, int]) -> np.ndarray:
    """To (width, height)."""
    if picture is None:
        return np.full((size[1], size[0], 3), _NOT_READ, np.uint8)
    if picture.shape[:2] == size[::-1]:
        return picture
    larger = size[1] >= picture.shape[0]
    method = Image.Resampling.NEAREST if larger else Image.Resampling.BOX
    return np.asarray(Image.fromarray(picture).resize(size, method))
