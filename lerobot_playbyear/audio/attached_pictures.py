"""The pictures of a dataset's sound: the levels that they share, and each frame's, made where it is asked for."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_playbyear.audio.attach_spectrogram import AttachSpectrogramError, PicturePlan
from lerobot_playbyear.audio.sound_picture import FLOOR_DB, SoundPicture
from lerobot_playbyear.datasets.parquet import PIECE_BYTES
from lerobot_playbyear.datasets.reader import DatasetReader, EpisodeRows
from lerobot_playbyear.datasets.statistics import Stats, picture_stats

_STEP_DB = 0.1  # of the histogram of levels
_LOUDEST_DB = 20.0  # a square wave at full scale has 2
_QUIET_SHARE = 0.01
_LEAST_RANGE_DB = 20.0  # so that the noise of a dataset in which nothing happens stays grey


def fit_levels(dataset: DatasetReader, plan: PicturePlan, given: tuple[float | None, float | None]) -> SoundPicture:
    """How one microphone's pictures are made, once all of its sound has been heard.

    Args:
        dataset: The dataset.
        plan: All but the levels.
        given: Levels that are black and white [dB]; None: the dataset's.

    Raises:
        AttachSpectrogramError: There is nothing but silence, or the levels do not go together.
    """
    how = SoundPicture(
        plan.microphone, plan.feature, plan.sample_rate, dataset.fps, plan.height, plan.width, plan.columns_per_frame,
        FLOOR_DB, _LOUDEST_DB, before_episode=(0,) * plan.height,
    )  # fmt: skip
    edges = np.arange(FLOOR_DB, _LOUDEST_DB + _STEP_DB / 2, _STEP_DB)
    counts = np.zeros((plan.height, len(edges) - 1), np.int64)
    bands = np.arange(plan.height)
    for sound, n_heard in tqdm(_contexts(dataset, how), "Hearing", len(dataset), unit="frame", delay=1):
        levels = how.levels(sound)[how.begun(n_heard)]
        bins = np.clip(((levels - FLOOR_DB) / _STEP_DB).astype(int), 0, counts.shape[1] - 1)
        for column in bins:
            counts[bands, column] += 1
    counts[:, 0] = 0  # digital silence, which no microphone has: something is missing there
    total = counts.sum(axis=0)
    low, high = given
    if not total.any() and (low is None or high is None):
        raise AttachSpectrogramError(
            f"'{plan.microphone}' holds nothing but silence. Choose others with --microphones, or give --low_db and --high_db."
        )
    heard = np.flatnonzero(total)
    if low is None:
        low = float(edges[np.searchsorted(np.cumsum(total), _QUIET_SHARE * total.sum())])
    if high is None:
        high = max(float(edges[heard[-1] + 1]), low + _LEAST_RANGE_DB)
    low, high = round(low, 1), round(high, 1)
    if not FLOOR_DB <= low < high:
        raise AttachSpectrogramError(
            f"--low_db={low:g} and --high_db={high:g}: wanted {FLOOR_DB:g} or more, and the second above the first."
        )
    halves = counts.sum(axis=1, keepdims=True) / 2
    median = edges[(np.cumsum(counts, axis=1) < halves).sum(axis=1)]  # (height,)
    usual = np.rint(255 * np.clip((median - low) / (high - low), 0, 1)).astype(int)
    return SoundPicture(
        plan.microphone, plan.feature, plan.sample_rate, dataset.fps, plan.height, plan.width, plan.columns_per_frame,
        low, high, tuple(usual.tolist()),
    )  # fmt: skip


class EpisodePictures:
    """One microphone's pictures of all episodes. Their columns, which neighbouring pictures share, are made once, in a file.

    Args:
        dataset: The dataset.
        how: How they are made.
        scratch: A folder for the file, which must outlive this.

    Raises:
        ValueError: A row is missing, or the episodes are not in their order.
    """

    def __init__(self, dataset: DatasetReader, how: SoundPicture, scratch: Path) -> None:
        self.how = how
        self._episodes = _episodes(dataset)
        shape = (len(dataset), how.columns_per_frame, how.height)
        self._columns = np.memmap(scratch / how.feature, np.uint8, "w+", shape=shape)
        frames = tqdm(_contexts(dataset, how), "Drawing", len(dataset), unit="frame", delay=1)
        for row, (sound, n_heard) in enumerate(frames):
            self._columns[row] = how.columns(sound, n_heard)

    @property
    def n_frames(self) -> list[int]:
        """Of each episode."""
        return [len(episode) for episode in self._episodes]

    @property
    def rows_at_once(self) -> int:
        """How many pictures may be in memory together."""
        return max(PIECE_BYTES // (3 * self.how.height * self.how.width), 1)

    def pictures(self, episode: int, start: int, stop: int) -> Iterator[np.ndarray]:
        """Those of an episode's frames, (height, width, 3) uint8 each.

        Raises:
            ValueError: There are no such frames.
        """
        n_frames = self.n_frames[episode] if 0 <= episode < len(self._episodes) else 0
        if not 0 <= start < stop <= n_frames:
            raise ValueError(
                f"it holds frames {start} to {stop - 1} of episode {episode}, for which meta/episodes counts {n_frames}"
            )
        first = self._episodes[episode].start
        for frame in range(start, stop):
            seen = self._columns[first + max(frame + 1 - self.how.n_frames, 0) : first + frame + 1]
            yield self.how.picture(seen.reshape(-1, self.how.height))

    def stats(self, episode: int) -> Stats:
        """An episode's statistics, of all of its pictures."""
        return {self.how.feature: picture_stats(self.pictures(episode, 0, self.n_frames[episode]))}


def _episodes(dataset: DatasetReader) -> list[EpisodeRows]:
    """All episodes, in their order."""
    if [episode.index for episode in dataset.episodes] != list(range(dataset.meta.total_episodes)):
        raise AttachSpectrogramError(
            f"The data files do not hold episodes 0 to {dataset.meta.total_episodes - 1} in this order. Repair the dataset "
            f"first: playbyear-repair --root={dataset.root}"
        )
    return dataset.episodes


def _contexts(dataset: DatasetReader, how: SoundPicture) -> Iterator[tuple[np.ndarray, int]]:
    """For every frame the samples that its columns depend on, (context,), and how many of them belong to its episode."""
    for episode in _episodes(dataset):
        sound = dataset.sound(how.microphone, episode)
        sound = np.concatenate([np.zeros(how.context, sound.dtype), sound])
        for n_heard in range(how.samples_per_frame, (len(episode) + 1) * how.samples_per_frame, how.samples_per_frame):
            yield sound[n_heard : n_heard + how.context], min(n_heard, how.context)
