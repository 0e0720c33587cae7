"""An episode of a dataset as a film with sound, in the formats that every browser plays: H.264 and AAC."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from lerobot_playbyear.film.video import film_sound, write_film

_SOUND_BIT_RATE = 200_000  # bits per second, of two channels
_LOWEST_BIT_RATE = 60_000  # of the pictures
_LIMITED_BIT_RATE = 20_000_000  # of the pictures; a film that may have more is not limited at all
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


def encode(
    path: Path,
    pictures: Iterator[np.ndarray],
    n_pictures: int,
    fps: float,
    sound: Sequence[np.ndarray],
    gain: float,
    most_bytes: int = 2**28,
) -> Path:
    """Writes an mp4 with the sound of the first two microphones, left and right, in time with the pictures.

    Args:
        path: Of the film.
        pictures: n pictures (H, W, 3) uint8, H and W even.
        n_pictures: n.
        fps: Frames per second [Hz].
        sound: As for `blocks_of`.
        gain: By how much to amplify.
        most_bytes: About how large it may become: the film of an episode of hours is coarser, so that a browser can
            hold it.
    """
    samples, sample_rate = film_sound(blocks_of(sound, n_pictures), fps, gain)
    # Key frames every second, so that stepping backwards is quick.
    options = {"crf": "23", "g": str(math.ceil(fps))}
    bit_rate = max(round(8 * most_bytes * fps / n_pictures) - _SOUND_BIT_RATE, _LOWEST_BIT_RATE)
    if bit_rate < _LIMITED_BIT_RATE:
        options |= {"maxrate": str(bit_rate), "bufsize": str(2 * bit_rate)}
    return write_film(path, pictures, fps, samples, sample_rate, options)


def blocks_of(sound: Sequence[np.ndarray], n_pictures: int) -> np.ndarray:
    """The sound of a film: of the first two microphones, or only of the first if their rates differ.

    Args:
        sound: For each microphone what it heard, (n * S,) in steps of 16-bit PCM; the block of frame t was heard before its
            picture was taken.
        n_pictures: n.

    Returns:
        (n, S, n_microphones) int16; (n, 0, 0) without a microphone.
    """
    heard = [own for own in sound[:2] if len(own) == len(sound[0])]
    if not heard:
        return np.zeros((n_pictures, 0, 0), np.int16)
    pcm = np.clip(np.stack(heard, axis=-1), -32768, 32767).astype(np.int16)
    return pcm.reshape(n_pictures, -1, len(heard))


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
