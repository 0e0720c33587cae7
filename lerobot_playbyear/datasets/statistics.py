"""A microphone's statistics: a few numbers per episode, in the shape that LeRobot's tools want.

LeRobot keeps minimum, maximum, mean, standard deviation and quantiles of every element of a feature, which for sound
means per sample index: 0.1 to 0.3 MB per episode that say the same thing thousands of times, since a sample's place
within a frame means nothing. LeRobot's appending and merging stack the statistics of episodes and datasets, so their
shape (S,) has to stay. Here every entry of such a vector is the statistic of all samples: parquet stores the
repetition in a few bytes, and whoever reads it sees what LeRobot would have written, without the noise.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import (
    DEFAULT_QUANTILES,
    RunningQuantileStats,
    aggregate_stats,
    compute_episode_stats,
    get_feature_stats,
)
from lerobot.datasets.utils import STATS_PATH, serialize_dict

from lerobot_playbyear.datasets.features import audio_keys

Stats = dict[str, dict[str, np.ndarray]]
"""Per feature and statistic, as LeRobot keeps them."""

Pieces = Callable[[], Iterable[np.ndarray]]
"""Gives an array in pieces (n, ...), from its beginning whenever it is called."""

_DIGITS = 5  # significant ones
_PIECE_SAMPLES = 2**20
_BINS = 5000  # of LeRobot's histograms


def sound_stats(waveform: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of all samples of a microphone's frames, each repeated to the shape (S,).

    Args:
        waveform: (N, S), the samples of N frames; it may lie in a file.
    """
    n_frames, n_samples = waveform.shape
    rows = max(_PIECE_SAMPLES // max(n_samples, 1), 1)
    return repeated_stats(lambda: (waveform[i : i + rows] for i in range(0, n_frames, rows)), n_frames, n_samples)


def repeated_stats(pieces: Pieces, n_frames: int, n_samples: int) -> dict[str, np.ndarray]:
    """As `sound_stats`, of sound that is not in memory as a whole.

    Args:
        pieces: The sound, in pieces (n, S).
        n_frames: N, their rows in all.
        n_samples: S.
    """
    first = next(iter(pieces()))
    if first.dtype in (np.int16, np.uint8):
        pooled = _integer_stats(pieces, first.dtype)
    elif len(first) == n_frames:
        pooled = {name: float(value[0]) for name, value in get_feature_stats(_column(first), 0, False).items()}
    else:
        pooled = _running_stats(pieces)
    stats = {name: np.full(n_samples, _rounded(value)) for name, value in pooled.items()}
    return {**stats, "count": np.array([n_frames])}


def channel_stats(pieces: Pieces, n_pictures: int) -> dict[str, np.ndarray]:
    """Statistics of pictures as LeRobot has them: of each channel, (C, 1, 1), for pixels in [0, 1].

    Args:
        pieces: The pictures, in pieces (n, C, H, W) uint8.
        n_pictures: How many there are in all.
    """
    first = next(iter(pieces()))
    if len(first) == n_pictures:
        lerobots = get_feature_stats(first, axis=(0, 2, 3), keepdims=True)
        return {
            name: value if name == "count" else np.squeeze(value / 255.0, axis=0) for name, value in lerobots.items()
        }
    n_channels = first.shape[1]
    counts = np.zeros((n_channels, 256), np.int64)
    for piece in pieces():
        for channel in range(n_channels):
            counts[channel] += np.bincount(piece[:, channel].reshape(-1), minlength=256)
    each = [_stats_of_counts(np.arange(256), own) for own in counts]
    stats = {name: np.array([own[name] for own in each]).reshape(-1, 1, 1) / 255.0 for name in each[0]}
    return {**stats, "count": np.array([n_pictures])}


def numeric_stats(columns: Mapping[str, np.ndarray], features: Mapping[str, Mapping[str, Any]]) -> Stats:
    """Statistics of one episode's numeric columns, as LeRobot computes them, and of its microphones.

    Args:
        columns: (N, ...) per feature.
        features: LeRobot features of these columns.
    """
    microphones = set(audio_keys(columns))
    others = {key: value for key, value in columns.items() if key not in microphones}
    stats = compute_episode_stats(others, dict(features)) if others else {}
    return {**stats, **{key: sound_stats(columns[key].reshape(len(columns[key]), -1)) for key in microphones}}


def with_sound_stats(rows: pa.Table, sound: Sequence[Stats]) -> pa.Table:
    """Rows of `meta/episodes`, with the statistics of each episode's microphones."""
    for key in sound[0] if sound else ():
        for name in sound[0][key]:
            rows = rows.append_column(f"stats/{key}/{name}", pa.array([own[key][name].tolist() for own in sound]))
    return rows


def row_stats(row: Mapping[str, Any]) -> Stats:
    """The statistics in an episode's row of `meta/episodes`, without those that are missing."""
    stats: Stats = {}
    for column, value in row.items():
        if column.startswith("stats/") and value is not None:
            key, name = column.removeprefix("stats/").rsplit("/", 1)
            stats.setdefault(key, {})[name] = np.atleast_1d(np.array(value))
    return stats


def add_stats(total: Stats | None, episodes: Iterable[Stats], microphones: Iterable[str]) -> Stats:
    """The statistics of a dataset after more episodes, aggregated by LeRobot."""
    parts = [*([total] if total else []), *episodes]
    summed = aggregate_stats(parts) if parts else {}
    for key in microphones:
        for name, value in summed.get(key, {}).items():
            if name != "count" and (value == value.flat[0]).all():
                summed[key][name] = np.full(value.shape, _rounded(float(value.flat[0])))
    return summed


def write_stats(stats: Stats, root: Path) -> None:
    """Writes `meta/stats.json` as LeRobot does, but each feature on one line: vectors of thousands take less room."""
    lines = [
        f"{json.dumps(key)}: {json.dumps(value, separators=(',', ':'))}" for key, value in serialize_dict(stats).items()
    ]
    path = root / STATS_PATH
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _integer_stats(pieces: Pieces, dtype: np.dtype) -> dict[str, float]:
    """From how often each value occurs, which says all that there is to know."""
    limits = np.iinfo(dtype)
    counts = np.zeros(limits.max - limits.min + 1, np.int64)
    for piece in pieces():
        counts += np.bincount(piece.reshape(-1).astype(np.int32) - limits.min, minlength=len(counts))
    return _stats_of_counts(np.arange(limits.min, limits.max + 1), counts)


def _stats_of_counts(values: np.ndarray, counts: np.ndarray) -> dict[str, float]:
    """What LeRobot's `get_feature_stats` says of values that occur so often.

    Args:
        values: (k,) in ascending order.
        counts: (k,)
    """
    values, counts = values[counts > 0].astype(np.float64), counts[counts > 0]
    n_values = counts.sum()
    mean = float(values @ counts / n_values)
    stats = {"min": values[0], "max": values[-1], "mean": mean}
    stats["std"] = math.sqrt(np.square(values - mean) @ counts / n_values)
    edges = np.linspace(values[0] - 1e-10, values[-1] + 1e-10, _BINS + 1)
    below = np.cumsum(np.histogram(values, bins=edges, weights=counts)[0])
    for share in DEFAULT_QUANTILES:
        stats[f"q{int(share * 100):02d}"] = _quantile(below, edges, share * n_values) if n_values > 1 else mean
    return stats


def _quantile(below: np.ndarray, edges: np.ndarray, wanted: float) -> float:
    """The value below which `wanted` values lie, where `below` counts those below each bin's upper edge."""
    bin_ = int(np.searchsorted(below, wanted))
    if bin_ in (0, len(below)):
        return float(edges[min(bin_, len(edges) - 1)])
    inside = below[bin_] - below[bin_ - 1]
    return float(edges[bin_] + (wanted - below[bin_ - 1]) / inside * (edges[bin_ + 1] - edges[bin_]))


def _running_stats(pieces: Pieces) -> dict[str, float]:
    """LeRobot's, in pieces. Its histogram is exact when it knows the range at once, so that comes first: two samples more."""
    ranges = [(float(piece.min()), float(piece.max())) for piece in pieces()]
    running = RunningQuantileStats()
    running.update(np.array([[min(low for low, _ in ranges)], [max(high for _, high in ranges)]]))
    for piece in pieces():
        running.update(_column(piece))
    return {name: float(value[0]) for name, value in running.get_statistics().items()}


def _column(sound: np.ndarray) -> np.ndarray:
    return sound.astype(np.float64).reshape(-1, 1)


def _rounded(value: float) -> float:
    if value == 0 or not math.isfinite(value):
        return value
    return round(value, _DIGITS - 1 - math.floor(math.log10(abs(value))))
