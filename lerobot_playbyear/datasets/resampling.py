"""The sound of a dataset at another sample rate, resampled episode by episode while it is read.

Only a piece of an episode is in memory as floats at a time. What was heard before an episode's first sample and after its
last is not known: there the sound goes on as its mirror image, turned about that sample, so that its edges do not ring.
"""

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_playbyear.datasets.audio_files import Resampled
from lerobot_playbyear.datasets.features import samples_per_frame, to_pcm_s16
from lerobot_playbyear.datasets.parquet import column_to_numpy, episode_bounds
from lerobot_playbyear.datasets.tensors import check_finite, finite_rows, read_rows

if TYPE_CHECKING:
    from lerobot.datasets import LeRobotDataset

    from lerobot_playbyear.datasets.long_dataset import LongDataset

_PCM_S16_FULL_SCALE = 32768
_SAMPLES_AT_ONCE = 2**20
_EDGE = 128  # samples of the lower rate: twice what the resampler's filter reaches


def features_at(features: Mapping[str, Any], sample_rates: Mapping[str, int], fps: int) -> dict[str, Any]:
    """A dataset's features, its microphones at other sample rates.

    Args:
        features: Of the dataset.
        sample_rates: By microphone [Hz]; what is not named, or has that rate, stays as it is.
        fps: The dataset's frames per second [Hz].

    Raises:
        ValueError: If the frame rate does not divide a sample rate.
    """
    changed = {}
    for key, rate in sample_rates.items():
        if key in features and sample_rate_in(features[key]) not in (None, rate):
            info = {**features[key]["info"], "sample_rate": rate}
            changed[key] = {**features[key], "shape": (samples_per_frame(rate, fps, key),), "info": info}
    return {**features, **changed}


def sample_rate_in(feature: Mapping[str, Any]) -> int | None:
    """What a feature says of its sample rate [Hz]; None: nothing."""
    return (feature.get("info") or {}).get("sample_rate")


def resampled_pieces(
    dataset: "LeRobotDataset | LongDataset", key: str, sample_rate: int, first: int = 0
) -> Iterator[np.ndarray]:
    """A microphone's rows from row `first` on at another sample rate, in pieces (n, S) of the stored form.

    Args:
        dataset: The dataset.
        key: The microphone.
        sample_rate: The rate wanted [Hz]; a multiple of the frame rate.
        first: The row to begin with.

    Raises:
        ValueError: If rows are missing, differ from the feature's shape, or hold NaN or infinite values, those before
            `first` included.
    """
    old_rate = int(dataset.meta.features[key]["info"]["sample_rate"])
    n_samples = samples_per_frame(sample_rate, dataset.fps, key)
    n_rows = max(_SAMPLES_AT_ONCE // n_samples, 1)
    divisor = math.gcd(old_rate, sample_rate)
    old, new = old_rate // divisor, sample_rate // divisor
    n_edges = math.ceil(_EDGE / min(old, new))  # so many times `old` samples are exactly as many times `new` ones
    episode_index = column_to_numpy(dataset.hf_dataset.data.column("episode_index"))
    finite = np.ones(len(episode_index), bool)
    finite[:first] = finite_rows(dataset, key, first)
    for start, end in zip(*episode_bounds(episode_index), strict=True):
        if end <= first:
            continue
        sound = _Mirrored(dataset, key, start, end, n_edges * old)
        resampled = Resampled(sound, old_rate, sample_rate)
        for row in range(max(start, first), end, n_rows):
            stop = min(row + n_rows, end)
            span = slice(n_edges * new + (row - start) * n_samples, n_edges * new + (stop - start) * n_samples)
            values = resampled[span].reshape(stop - row, n_samples)
            finite[row:stop] = np.isfinite(values).all(axis=1)
            yield to_pcm_s16(values) if sound.is_pcm else values
    check_finite(finite, key, episode_index)


class _Mirrored:
    """The samples of an episode, (n + 2 * margin, 1) float32, read where they are indexed."""

    def __init__(self, dataset: "LeRobotDataset | LongDataset", key: str, start: int, end: int, margin: int) -> None:
        self._dataset, self._key, self._start, self._margin = dataset, key, start, margin
        (self._per_row,) = dataset.meta.features[key]["shape"]
        self._n = (end - start) * self._per_row
        self.shape = (self._n + 2 * margin, 1)
        self.is_pcm = dataset.meta.features[key]["dtype"] == "int16"
        self._first, self._last = self._read(0, 1), self._read(self._n - 1, self._n)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, span: slice) -> np.ndarray:
        start, stop, _ = span.indices(len(self))
        wanted = np.arange(start, stop) - self._margin
        before, after = wanted < 0, wanted >= self._n
        there = np.where(before, -wanted, np.where(after, 2 * (self._n - 1) - wanted, wanted)).clip(0, self._n - 1)
        lowest = int(there.min())
        values = self._read(lowest, int(there.max()) + 1)[there - lowest]
        values[before] = 2 * self._first - values[before]
        values[after] = 2 * self._last - values[after]
        return values[:, None]

    def _read(self, start: int, stop: int) -> np.ndarray:
        """Samples of the episode itself, as floats."""
        row, end = start // self._per_row, -(-stop // self._per_row)
        rows = read_rows(self._dataset, self._key, self._start + row, end - row)
        samples = rows.reshape(-1)[start - row * self._per_row : stop - row * self._per_row].astype(np.float32)
        return samples / _PCM_S16_FULL_SCALE if self.is_pcm else samples
