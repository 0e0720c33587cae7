"""The sound of whole datasets, decoded to files, and read from them where it is indexed."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lerobot_playbyear.datasets.audio_files import Cut
from lerobot_playbyear.datasets.parquet_files import PIECE_BYTES
from lerobot_playbyear.datasets.statistics import Stats, repeated_stats


class SpooledFile:
    """The samples of a sound file, (n, channels) int16, decoded to a file of their own.

    Args:
        path: That file.
        n_channels: Of the samples in it.
    """

    def __init__(self, path: Path, n_channels: int) -> None:
        self._path = path
        self.shape = (path.stat().st_size // (2 * n_channels), n_channels)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        n_channels = self.shape[1]
        values = np.fromfile(self._path, np.int16, max(stop - start, 0) * n_channels, offset=2 * start * n_channels)
        return values.reshape(-1, n_channels)


@dataclass
class EpisodesSound:
    """The sound of all episodes.

    Args:
        sample_rate: [Hz].
        keys: The columns.
        samples_per_frame: S.
        episodes: For each episode (n_frames * S, columns) int16, read where it is indexed.
    """

    sample_rate: int
    keys: list[str]
    samples_per_frame: int
    episodes: list[Cut]

    @property
    def rows_at_once(self) -> int:
        """How many frames' sound is in memory together."""
        return max(PIECE_BYTES // (2 * self.samples_per_frame * len(self.keys)), 1)

    def check(self, episode: int, first: int, last: int) -> None:
        """Whether there are such frames.

        Raises:
            ValueError: There are not.
        """
        n_frames = len(self.episodes[episode]) // self.samples_per_frame if 0 <= episode < len(self.episodes) else 0
        if not 0 <= first <= last < n_frames:
            raise ValueError(
                f"it holds frames {first} to {last} of episode {episode}, for which meta/episodes counts {n_frames}"
            )

    def blocks(self, episode: int, start: int, stop: int) -> np.ndarray:
        """Of some of an episode's frames, (n, S, columns) int16."""
        size = self.samples_per_frame
        return self.episodes[episode][start * size : stop * size].reshape(-1, size, len(self.keys))

    def stats(self, episode: int) -> Stats:
        """An episode's statistics."""
        n_frames = len(self.episodes[episode]) // self.samples_per_frame

        def pieces(column: int) -> Iterator[np.ndarray]:
            for start in range(0, n_frames, self.rows_at_once):
                yield self.blocks(episode, start, min(start + self.rows_at_once, n_frames))[..., column]

        return {
            key: repeated_stats(partial(pieces, column), n_frames, self.samples_per_frame)
            for column, key in enumerate(self.keys)
        }
