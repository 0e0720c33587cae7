"""The sound of the last seconds as a picture, which policies that know nothing of sound can look at.

A log-mel spectrogram: low frequencies at the bottom, the newest sound at the right, grey in three channels. Every frame adds
the same whole number of columns, so that what was heard before moves to the left without changing: such pictures compress
well, and a column never depends on what comes after it. Black and white stand for two levels that are fixed for a dataset.

Here is numpy alone, in double precision and without matrix products, whose sums depend on how many threads there are: the
same samples give the same picture, whichever process makes it. Environments need neither torch nor LeRobot for it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.features import AUDIO_PREFIX, Features, samples_per_frame
from lerobot_playbyear.datasets.files import INFO_PATH, parse_json
from lerobot_playbyear.datasets.frame_rate import divides

PICTURE_PREFIX = "observation.images."
"""What the key of every picture starts with, those of cameras as well."""

INFO_KEY = "spectrogram"
"""Where a picture's feature says how it was made, in its `info`."""

FLOOR_DB = -100.0
"""Of full scale: below what 16 bits can hold. Nothing is quieter."""

_LAYOUT = 1  # of what is computed; another number when it changes
_FULL_SCALE = 32768.0  # int16 PCM
_SHORTEST_SEGMENT_S = 0.04  # as in "Play it by Ear", appendix: 1,920 samples at 48 kHz
_LONGEST_FFT = 2**18
_LARGEST = 4096  # pixels along a side
_ROLLING_S = 2.0


@dataclass(frozen=True)
class SoundPicture:
    """How one microphone's pictures are made.

    Args:
        microphone: Its key, `observation.audio.<microphone>`.
        feature: The pictures' key, `observation.images.<name>`.
        sample_rate: Of the microphone [Hz].
        fps: Frames per second [Hz].
        height: Mel bands, from 0 Hz to half the sample rate [pixels].
        width: Columns [pixels].
        columns_per_frame: By how many the picture moves to the left from one frame to the next.
        low_db, high_db: Levels that are black and white [dB; a sine at full scale has 0 in its bin].
        before_episode: What stands for the time before the episode: each band's median in the dataset, (height,) of 0 to 255,
            the lowest frequency first. Silence would tell a policy loudly how long ago the episode began.
        layout: Of what is computed.

    Raises:
        InputError: The numbers do not go together.
    """

    microphone: str
    feature: str
    sample_rate: int
    fps: float
    height: int
    width: int
    columns_per_frame: int
    low_db: float
    high_db: float
    before_episode: tuple[int, ...]
    layout: int = _LAYOUT

    def __post_init__(self) -> None:
        if self.layout != _LAYOUT:
            raise self._error("layout", f"{_LAYOUT}, which this version makes")
        for name in ("sample_rate", "height", "width", "columns_per_frame"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise self._error(name, "a whole number above 0")
        for name, prefix in (("microphone", AUDIO_PREFIX), ("feature", PICTURE_PREFIX)):
            if not str(getattr(self, name)).startswith(prefix):
                raise self._error(name, f"a key that begins with {prefix}")
        for name in ("height", "width"):
            if getattr(self, name) > _LARGEST:
                raise self._error(name, f"at most {_LARGEST} pixels")
        if isinstance(self.fps, bool) or not isinstance(self.fps, int | float) or not 1 <= self.fps <= self.sample_rate:
            raise self._error("fps", f"a number from 1 to sample_rate={self.sample_rate}")
        if not divides(self.fps, self.sample_rate) or self.columns_per_frame > self.samples_per_frame:
            raise self._error("columns_per_frame", "at most sample_rate / fps: more seconds, or a smaller width")
        if not FLOOR_DB <= self.low_db < self.high_db:
            raise self._error("low_db", f"at least {FLOOR_DB:g}, and below high_db={self.high_db}")
        object.__setattr__(self, "before_episode", tuple(self.before_episode))
        if len(self.before_episode) != self.height or not all(0 <= level <= 255 for level in self.before_episode):
            raise self._error("before_episode", f"{self.height} numbers of 0 to 255")

    @property
    def name(self) -> str:
        """Of the picture among those of an environment."""
        return self.feature.removeprefix(PICTURE_PREFIX)

    @property
    def samples_per_frame(self) -> int:
        return samples_per_frame(self.sample_rate, self.fps)

    @property
    def seconds(self) -> float:
        """That the picture shows."""
        return self.width / (self.columns_per_frame * self.fps)

    @property
    def segment(self) -> int:
        """Samples behind one column: those of two columns, and no fewer than 0.04 s."""
        two = 2 * -(-self.samples_per_frame // self.columns_per_frame)
        return max(two, round(_SHORTEST_SEGMENT_S * self.sample_rate))

    @property
    def context(self) -> int:
        """Samples that one frame's columns depend on: its own, and some before it."""
        return self.samples_per_frame + self.segment

    def levels(self, sound: np.ndarray) -> np.ndarray:
        """A frame's columns as levels.

        Args:
            sound: (context,), the samples up to the frame: int16 PCM, or floats in [-1, 1].

        Returns:
            (columns_per_frame, height) [dB], the lowest frequency first.
        """
        return self.levels_of(np.stack([sound[end - self.segment : end] for end in self._ends]))

    def levels_of(self, segments: np.ndarray) -> np.ndarray:
        """The levels of columns, (n, height) [dB], from the samples behind each, (n, segment)."""
        wave = segments / _FULL_SCALE if segments.dtype.kind == "i" else segments.astype(np.float64)
        size, bins, weights, firsts = self._bank
        spectrum = np.fft.rfft(wave * self._window, size)
        power = spectrum.real**2 + spectrum.imag**2  # (n, bins)
        bands = np.add.reduceat(power[:, bins] * weights, firsts, axis=1)
        return 10 * np.log10(bands + 10 ** (FLOOR_DB / 10))

    def pixels_of(self, levels: np.ndarray) -> np.ndarray:
        """Levels [dB] as grey, uint8."""
        share = (levels - self.low_db) / (self.high_db - self.low_db)
        return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)

    def columns(self, sound: np.ndarray, n_heard: int) -> np.ndarray:
        """A frame's columns as pixels.

        Args:
            sound: As for `levels`.
            n_heard: How many of these samples, the last ones, belong to the episode. A column of which a sample does not
                is what stands before the episode.

        Returns:
            (columns_per_frame, height) uint8, the lowest frequency first.
        """
        pixels = self.pixels_of(self.levels(sound))
        return np.where(self.begun(n_heard)[:, None], pixels, np.array(self.before_episode, np.uint8))

    def begun(self, n_heard: int) -> np.ndarray:
        """Which of a frame's columns hear nothing but the episode, (columns_per_frame,) bool. `n_heard` as for `columns`."""
        return np.array(self._ends) - self.segment >= self.context - n_heard

    def picture(self, columns: np.ndarray) -> np.ndarray:
        """What a frame's picture is.

        Args:
            columns: (n, height) uint8, those of the episode up to this frame, or of as many of its last frames as fill it.

        Returns:
            (height, width, 3) uint8.
        """
        columns = columns[-self.width :]
        before = np.broadcast_to(np.array(self.before_episode, np.uint8), (self.width - len(columns), self.height))
        grey = np.concatenate([before, columns]).T[::-1]  # (height, width), low frequencies at the bottom
        return np.repeat(grey[:, :, None], 3, axis=2)

    def as_info(self) -> dict[str, Any]:
        """As it stands in the feature's `info`."""
        return {INFO_KEY: {**asdict(self), "before_episode": list(self.before_episode)}}

    @cached_property
    def _ends(self) -> list[int]:
        """Where each column's segment ends in `context` samples; the last one ends with the frame."""
        size, n = self.samples_per_frame, self.columns_per_frame
        return [self.context - size + (column + 1) * size // n for column in range(n)]

    @cached_property
    def _window(self) -> np.ndarray:
        window = np.sin(np.pi * np.arange(self.segment) / self.segment) ** 2  # Hann's, periodic
        return 2 * window / window.sum()

    @cached_property
    def _bank(self) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
        """The size of the transform, so large that no band is without a bin; the bins of all bands one after the other, their
        weights, and where each band begins among them."""
        size = 1 << (self.segment - 1).bit_length()
        bank = mel_bank(self.height, size, self.sample_rate)
        while not all(len(bins) for bins, _ in bank):
            size *= 2
            if size > _LONGEST_FFT:
                raise self._error("height", "fewer bands")
            bank = mel_bank(self.height, size, self.sample_rate)
        bins, weights = map(np.concatenate, zip(*bank, strict=True))
        return size, bins, weights, np.cumsum([0, *(len(bins) for bins, _ in bank[:-1])])

    def _error(self, name: str, wanted: str) -> InputError:
        return InputError(f"The picture of '{self.microphone}': {name}={getattr(self, name)!r}; wanted {wanted}.")


class HeardSound:
    """What a microphone hears in an episode, frame by frame, as pictures.

    Args:
        picture: How they are made.
    """

    def __init__(self, picture: SoundPicture) -> None:
        self._how = picture
        self._frames: deque[np.ndarray] = deque(maxlen=-(-picture.width // picture.columns_per_frame))
        self._blocks: deque[np.ndarray] = deque(maxlen=-(-picture.context // picture.samples_per_frame))

    def clear(self) -> None:
        """An episode begins."""
        self._frames.clear()
        self._blocks.clear()

    def hear(self, block: np.ndarray) -> tuple[np.ndarray, int]:
        """Takes the samples since the previous frame, (S,), and gives those that the frame's columns depend on, (context,), and
        how many of them belong to the episode."""
        self._blocks.append(block.copy())
        heard = np.concatenate(self._blocks)[-self._how.context :]
        return np.concatenate([np.zeros(self._how.context - len(heard), heard.dtype), heard]), len(heard)

    def add(self, block: np.ndarray) -> np.ndarray:
        """Takes the samples since the previous frame, (S,), and gives the frame's picture, (height, width, 3) uint8. Its
        columns, which later frames share, are made once."""
        self._frames.append(self._how.columns(*self.hear(block)))
        return self._how.picture(np.concatenate(self._frames))


class RollingSpectrogram:
    """The last two seconds of a microphone, drawn a few columns at a time: what is drawn once moves to the left.

    Args:
        sample_rate: [Hz].
        height, width: Of the picture [pixels].
        low_db, high_db: Levels that are black and white [dB].

    Raises:
        InputError: The picture is too large, or the levels are in another order.
    """

    def __init__(self, sample_rate: int, height: int, width: int, low_db: float, high_db: float) -> None:
        wanted = width / _ROLLING_S
        per_second = min((n for n in range(1, 4 * width) if sample_rate % n == 0), key=lambda n: abs(n - wanted))
        self._hop = sample_rate // per_second
        names, size = (AUDIO_PREFIX + "microphone", PICTURE_PREFIX + "microphone"), (height, width)
        self._look = SoundPicture(*names, sample_rate, per_second, *size, 1, low_db, high_db, (0,) * height)
        self._grey = np.zeros((height, width), np.uint8)
        self._n_drawn = 0

    def draw(self, counter: int, samples: Callable[[int, int], np.ndarray]) -> np.ndarray:
        """The picture when `counter` samples had come.

        Args:
            samples: Gives those from one number to before another, (n,) int16.

        Returns:
            (height, width) uint8, low frequencies at the bottom, the newest sound at the right; it is drawn on later.
        """
        n, (_, width) = counter // self._hop, self._grey.shape
        n_new = min(n - self._n_drawn, width)
        if n_new > 0:
            segment = self._look.segment
            sound = samples((n - n_new + 1) * self._hop - segment, n * self._hop)
            segments = np.lib.stride_tricks.sliding_window_view(sound, segment)[:: self._hop]  # (n_new, segment)
            self._grey[:, : width - n_new] = self._grey[:, n_new:]
            self._grey[:, width - n_new :] = self._look.pixels_of(self._look.levels_of(segments)).T[::-1]
            self._n_drawn = n
        return self._grey


def mel_bank(n_bands: int, fft_size: int, sample_rate: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Overlapping triangles, equally wide on the mel scale (2595 log10(1 + f / 700), as torchaudio's default has it).

    Returns:
        For each band the bins with a weight, which follow each other, and their weights.
    """
    highest = 2595 * np.log10(1 + sample_rate / 2 / 700)
    edges = 700 * (10 ** (np.linspace(0, highest, n_bands + 2) / 2595) - 1)
    frequency = np.arange(fft_size // 2 + 1) * (sample_rate / fft_size)
    bank = []
    for low, peak, high in zip(edges, edges[1:], edges[2:], strict=False):
        weights = np.minimum((frequency - low) / (peak - low), (high - frequency) / (high - peak))
        inside = np.flatnonzero(weights > 0)
        bank.append((inside, weights[inside]))
    return bank


def pictures_of(features: Features) -> list[SoundPicture]:
    """The pictures of sound among a dataset's features.

    Raises:
        InputError: What one says of itself is not what is wanted.
    """
    found = []
    names = {one.name for one in fields(SoundPicture)}
    for key, feature in features.items():
        said = (feature.get("info") or {}).get(INFO_KEY)
        if said is None:
            continue
        if not isinstance(said, dict) or set(said) != names:
            raise InputError(f"'{key}': {INFO_KEY} is {said!r}; wanted the fields {', '.join(sorted(names))}.")
        try:
            found.append(SoundPicture(**said))
        except TypeError as error:
            raise InputError(f"'{key}': {INFO_KEY} in its info cannot be read: {error}.") from error
    return found


def read_pictures(path: str | Path) -> list[SoundPicture]:
    """How the pictures of a dataset were made.

    Args:
        path: The dataset's folder, or its `meta/info.json`, also one that was copied elsewhere.

    Raises:
        InputError: There is none, or it has no pictures of sound.
    """
    path = Path(path)
    file = path / INFO_PATH if path.is_dir() else path
    try:
        pictures = pictures_of(parse_json(file.read_text())["features"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{file} cannot be read ({error}); wanted a dataset's folder or its {INFO_PATH}, from playbyear-attach-spectrogram"
        ) from error
    if not pictures:
        raise InputError(f"{file} names no pictures of sound; make some: playbyear-attach-spectrogram")
    return pictures
