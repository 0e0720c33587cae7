"""A film of one episode for a dataset's card: all cameras side by side, the sound, and its spectrogram below."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_playbyear.film.video import amplify, at_a_rate_of_aac, compose, episode_sound, write_film
from lerobot_playbyear.inspection.film import tile
from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.structure_checks import fit_microphones

_LONGEST_S = 30
_PICTURE_HEIGHT = 336  # pixels, at most
_BLANK = np.zeros((2, 480, 3), np.uint8)  # above the spectrogram of a dataset without cameras


@dataclass(frozen=True)
class Preview:
    """What a film shows.

    Args:
        episode: The index of its episode.
        microphones: The keys of those that are heard: the first two where they have one rate, left and right.
        is_whole: Whether it shows the whole episode.
    """

    episode: int
    microphones: tuple[str, ...]
    is_whole: bool


def film_preview(source: DatasetSource, path: Path) -> Preview:
    """Films the first episode with success, or without any the first, for at most 30 seconds.

    Args:
        source: The dataset.
        path: The mp4 to write.
    """
    solved = [each for each in source.episodes if source.succeeded(each) not in (None, -1)]
    episode = (solved or source.episodes)[0]
    n_frames = min(len(episode), _LONGEST_S * source.fps)
    microphones = _heard_together(source, fit_microphones(source))
    shown = Episode(episode.index, episode.start, episode.start + n_frames)
    blocks = [
        np.clip(source.sound(key, shown)[:], -32768, 32767).astype(np.int16).reshape(n_frames, -1)
        for key in microphones
    ]
    stacked = np.stack(blocks, axis=-1) if blocks else np.zeros((n_frames, 0, 0), np.int16)  # (n, S, n_microphones)
    heard, sample_rate = at_a_rate_of_aac(amplify(episode_sound(stacked)), stacked.shape[1] * source.fps)
    pictures, sound = itertools.islice(_pictures(source, shown), n_frames), heard[:]
    write_film(path, compose(pictures, n_frames, sound, sample_rate), source.fps, sound, sample_rate)
    return Preview(episode.index, tuple(microphones), n_frames == len(episode))


def _pictures(source: DatasetSource, episode: Episode) -> Iterator[np.ndarray]:
    if not source.cameras:
        return itertools.repeat(_BLANK)
    streams = {camera: source.pictures(episode, camera) for camera in source.cameras}
    return tile(streams, len(episode), _PICTURE_HEIGHT)[1]


def _heard_together(source: DatasetSource, microphones: list[str]) -> list[str]:
    first_two = microphones[:2]
    rates = {source.features[key]["shape"][0] for key in first_two}
    return first_two if len(rates) == 1 else first_two[:1]
