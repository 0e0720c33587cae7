"""Films with sound: pictures of an episode above the spectrogram of what was heard, and the sound itself."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image, ImageDraw

from lerobot_playbyear.audio.audio_files import resample
from lerobot_playbyear.datasets.files import new_file
from lerobot_playbyear.datasets.frame_rate import exact_rate, sample_rate_of

_AAC_RATES = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)
_STRIP_HEIGHT = 120  # pixels
_INSET_SHARE = 0.28  # of the picture's height
TOP_FREQUENCY = 8000  # Hz, upper edge of spectrograms
WINDOW_S = 0.032  # of sound behind each of their columns
_POWER_FLOOR = 1e-12
_DYNAMIC_RANGE_DB = 70.0
_DIMMED = 0.4  # brightness of what has not been heard yet
_LOUDEST = 0.7  # of full scale
_MAX_GAIN = 100.0
_SOUND_BIT_RATE = 200_000  # bits per second, of two channels
_LOWEST_BIT_RATE = 60_000  # of the pictures
_LIMITED_BIT_RATE = 20_000_000  # of the pictures; a film that may have more is not limited at all
_MOST_BYTES = 2**28  # of an episode's film, about: one of hours is coarser, so that a browser can hold it
_NOT_READ = 96  # grey level of a picture that could not be read
_EMPTY_SIZE = 16  # pixels; the picture of an episode without cameras, which the page hides
# Control points of a dark-to-bright colour scale whose lightness grows evenly.
_COLOURS = np.array(
    [(0, 0, 4), (40, 11, 84), (101, 21, 110), (159, 42, 99), (212, 72, 66), (245, 125, 21), (252, 255, 164)]
)


def film_sound(
    sound: Sequence[np.ndarray], n_pictures: int, fps: float, gain: float | None = None
) -> tuple[np.ndarray, int]:
    """The sound of a film: in time with its pictures, amplified, and at a sample rate that AAC has.

    The block of frame t was heard before its picture was taken, so the film, which shows picture t from then on,
    plays block t + 1 with it; silence goes with the last picture.

    Args:
        sound: For each microphone what it heard, (n * S,) in steps of 16-bit PCM. The first two are heard, or only the first
            if their rates differ.
        n_pictures: n.
        fps: Frames per second.
        gain: By how much it is amplified; None: see `amplify`.

    Returns:
        (n, n_microphones) int16, and the sample rate [Hz].
    """
    heard = [own for own in sound[:2] if len(own) == len(sound[0])]
    size = len(heard[0]) // n_pictures if heard else 0
    rate = next((rate for rate in _AAC_RATES if rate >= sample_rate_of(size, fps)), _AAC_RATES[-1])
    if not size:
        return np.zeros((0, 0), np.int16), rate
    pcm = np.clip(np.stack(heard, axis=-1), -32768, 32767).astype(np.int16)  # (n * S, n_microphones)
    shifted = np.concatenate([pcm[size:], np.zeros_like(pcm[:size])])
    return resample(amplify(shifted, gain), sample_rate_of(size, fps), rate), rate


def amplify(samples: np.ndarray, gain: float | None = None) -> np.ndarray:
    """Makes the loudest sample 70 % of full scale, unless a gain is given; int16 in, int16 out."""
    if gain is None:
        gain = gain_of(np.abs(samples.astype(np.int32)).max(initial=0) / 32768)
    return np.clip(samples * np.float32(gain), -32768, 32767).astype(np.int16)


def gain_of(peak: float) -> float:
    """What makes `peak`, as a share of full scale, 70 % of it; at most 40 dB."""
    return min(_LOUDEST / max(peak, 1e-6), _MAX_GAIN)


def spectra(columns: np.ndarray, sample_rate: int) -> np.ndarray:
    """Level in frequency bins from 0 Hz to at most 8 kHz, (n, bins) [dB re a full-scale sine].

    Args:
        columns: (n, window) in [-1, 1].
        sample_rate: [Hz].
    """
    taper = np.hanning(columns.shape[1])
    power = np.square(np.abs(np.fft.rfft(columns * taper, axis=1))) * (4 / taper.sum() ** 2)
    n_bins = min(power.shape[1], int(TOP_FREQUENCY * columns.shape[1] / sample_rate) + 1)
    return 10 * np.log10(power[:, :n_bins] + _POWER_FLOOR)


def spectrogram_strip(samples: np.ndarray, sample_rate: int, width: int, height: int) -> np.ndarray:
    """Draws a whole episode's spectrogram.

    Args:
        samples: (n,) int16.
        sample_rate: [Hz].
        width, height: Of the drawing [pixels]: time runs from left to right, frequency from 0 at the bottom up to
            8 kHz, or half the sample rate.

    Returns:
        (height, width, 3) uint8; 70 dB from the darkest to the brightest colour.
    """
    window = max(int(WINDOW_S * sample_rate), 16)
    padded = np.pad(samples.astype(np.float32) / 32768, window // 2 + 1)
    starts = np.linspace(0, max(len(padded) - window, 0), width).astype(int)
    levels = spectra(padded[starts[:, None] + np.arange(window)], sample_rate)  # (width, bins)
    level = np.clip(1 + (levels - levels.max()) / _DYNAMIC_RANGE_DB, 0, 1)
    rows = np.linspace(level.shape[1] - 1, 0, height).round().astype(int)
    level = level[:, rows].T  # (height, width)
    scale = np.linspace(0, 1, len(_COLOURS))
    return np.stack([np.interp(level, scale, channel) for channel in _COLOURS.T], axis=-1).astype(np.uint8)


def inset(picture: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Puts what the policy's camera sees into the lower left corner of a picture for people.

    Args:
        picture: (H, W, 3) uint8.
        view: (h, w, 3) uint8, any size.
    """
    height = int(picture.shape[0] * _INSET_SHARE)
    size = (round(height * view.shape[1] / view.shape[0]), height)
    framed = Image.fromarray(picture)
    corner = (8, framed.height - height - 8)
    framed.paste((255, 255, 255), (corner[0] - 1, corner[1] - 1, corner[0] + size[0] + 1, corner[1] + size[1] + 1))
    framed.paste(Image.fromarray(view).resize(size, Image.Resampling.NEAREST), corner)
    ImageDraw.Draw(framed).text((corner[0], corner[1] - 14), "policy's camera", fill=(255, 255, 255))
    return np.asarray(framed)


def compose(pictures: Iterable[np.ndarray], n_frames: int, sound: np.ndarray, sample_rate: int) -> Iterator[np.ndarray]:
    """Puts each picture above the spectrogram strip, with a cursor at the picture's time.

    Args:
        pictures: T + 1 pictures (H, W, 3) uint8.
        n_frames: T + 1.
        sound: (n, n_microphones) int16, as long as the film. The strip shows the first microphone; without a
            microphone there is no strip.
        sample_rate: [Hz].

    Returns:
        The film's frames, (H + 120, W, 3) uint8.
    """
    if not sound.shape[1]:
        yield from pictures
        return
    strip = None
    for index, picture in enumerate(pictures):
        width = picture.shape[1]
        if strip is None:
            strip = spectrogram_strip(sound[:, 0], sample_rate, width, _STRIP_HEIGHT)
            labelled = Image.fromarray(strip)
            top = f"{min(TOP_FREQUENCY, sample_rate // 2) / 1000:g} kHz"
            ImageDraw.Draw(labelled).text((4, 2), top, fill=(255, 255, 255))
            strip = np.asarray(labelled)
        cursor = min(round(width * (index + 1) / n_frames), width - 1)
        shown = strip.copy()
        shown[:, cursor:] = (shown[:, cursor:] * _DIMMED).astype(np.uint8)
        shown[:, max(cursor - 1, 0) : cursor + 1] = 255
        yield np.concatenate([picture, shown])


def write_film(
    path: str | Path,
    frames: Iterable[np.ndarray],
    fps: float,
    sound: np.ndarray,
    sample_rate: int,
    x264_options: Mapping[str, str] | None = None,
) -> Path:
    """Writes an mp4 that browsers and video players take (H.264 and AAC).

    Args:
        path: Of the file; its folder is made.
        frames: (H, W, 3) uint8; of an odd side the last row or column is left out, as H.264 wants it.
        fps: Frames per second.
        sound: (n, n_microphones) int16. One microphone is mono, two are left and right, of
            more only the first two are heard; none makes a silent film.
        sample_rate: [Hz].
        x264_options: Of the H.264 encoder, in addition to its preset; by default constant quality 20.

    Returns:
        The path. The file is there only when it is complete.
    """
    path, n_channels = Path(path), min(sound.shape[1], 2)
    with new_file(path) as partial, av.open(str(partial), "w", options={"movflags": "+faststart"}) as film:
        audio: Any = None
        if n_channels:
            audio = film.add_stream("aac", rate=sample_rate)
            audio.layout, audio.bit_rate = "stereo" if n_channels == 2 else "mono", 96_000 * n_channels
        video: Any = None
        for index, picture in enumerate(frames):
            height, width = (size - size % 2 for size in picture.shape[:2])
            picture = picture[:height, :width]
            if video is None:
                video = film.add_stream("libx264", rate=exact_rate(fps))
                video.height, video.width, video.pix_fmt = height, width, "yuv420p"
                video.options = {"crf": "20", "preset": "veryfast", **(x264_options or {})}
            film.mux(video.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
            if audio is not None:
                first, end = (round(i * sample_rate / fps) for i in (index, index + 1))
                if first < len(sound):
                    film.mux(audio.encode(_audio_frame(sound[first:end][:, :2], sample_rate, first)))
        if video is None:
            raise ValueError("A film needs at least one frame.")
        for stream in (video, audio):
            if stream is not None:
                film.mux(stream.encode(None))
    return path


def _audio_frame(samples: np.ndarray, sample_rate: int, first_sample: int) -> av.AudioFrame:
    """Samples (n, 1 or 2) of 16-bit PCM [Hz: `sample_rate`] as FFmpeg takes them, from the place `first_sample` on."""
    layout = "stereo" if samples.shape[1] == 2 else "mono"
    frame = av.AudioFrame.from_ndarray(samples.astype(np.int16).reshape(1, -1), format="s16", layout=layout)
    frame.sample_rate, frame.pts, frame.time_base = sample_rate, first_sample, Fraction(1, sample_rate)
    return frame


# Of an episode of a dataset


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
    path: Path, pictures: Iterator[np.ndarray], n_pictures: int, fps: float, sound: Sequence[np.ndarray], gain: float
) -> Path:
    """Writes an mp4 with the sound of the first two microphones, left and right, in time with the pictures.

    Args:
        path: Of the film.
        pictures: n pictures (H, W, 3) uint8, H and W even.
        n_pictures: n.
        fps: Frames per second [Hz].
        sound: As for `film_sound`.
        gain: By how much to amplify.
    """
    samples, sample_rate = film_sound(sound, n_pictures, fps, gain)
    # Key frames every second, so that stepping backwards is quick.
    options = {"crf": "23", "g": str(math.ceil(fps))}
    bit_rate = max(round(8 * _MOST_BYTES * fps / n_pictures) - _SOUND_BIT_RATE, _LOWEST_BIT_RATE)
    if bit_rate < _LIMITED_BIT_RATE:
        options |= {"maxrate": str(bit_rate), "bufsize": str(2 * bit_rate)}
    return write_film(path, pictures, fps, samples, sample_rate, options)


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
