"""An episode's statistics, LeRobot's but for microphones: a few numbers, in the shape that LeRobot's tools want.

LeRobot keeps minimum, maximum, mean, standard deviation and quantiles of every element of a feature, which for sound
means per sample index: 0.1 to 0.3 MB per episode that say the same thing thousands of times, since a sample's place
within a frame means nothing. LeRobot's appending and merging stack the statistics of episodes and datasets, so their
shape (S,) has to stay. Here every entry of such a vector is the statistic of all samples: parquet stores the
repetition in a few bytes, and whoever reads it sees what LeRobot would have written, without the noise.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import compute_stats
from lerobot.datasets.utils import STATS_PATH, serialize_dict

from lerobot_playbyear.datasets.features import AUDIO_PREFIX, Features, audio_keys

Stats = dict[str, dict[str, np.ndarray]]
"""Per feature and statistic, as LeRobot keeps them."""


def sound_stats(sound: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of all samples of a microphone's frames, each repeated to the shape (S,).

    Args:
        sound: (N, S), the samples of N frames.
    """
    n_frames, n_samples = sound.shape
    values, counts = np.unique(sound, return_counts=True)  # in little memory where they are PCM
    values = values.astype(np.float64)
    mean = float(values @ counts / sound.size)
    pooled = {"min": values[0], "max": values[-1], "mean": mean}
    pooled["std"] = np.sqrt(np.square(values - mean) @ counts / sound.size)
    below = np.cumsum(counts)
    for share in compute_stats.DEFAULT_QUANTILES:
        pooled[f"q{int(share * 100):02d}"] = values[np.searchsorted(below, share * sound.size)]
    stats = {name: np.full(n_samples, _rounded(value)) for name, value in pooled.items()}
    return {**stats, "count": np.array([n_frames])}


def picture_stats(pictures: Iterable[np.ndarray], is_depth: bool = False) -> dict[str, np.ndarray]:
    """Statistics of pictures as LeRobot has them: of each channel, (C, 1, 1), for pixels in [0, 1].

    Args:
        pictures: (H, W, C) each; of an episode those that LeRobot's `sample_indices` names.
        is_depth: Whether they are distances, which keep their unit.
    """
    seen = np.stack([compute_stats.auto_downsample_height_width(picture.transpose(2, 0, 1)) for picture in pictures])
    stats = compute_stats.get_feature_stats(seen, axis=(0, 2, 3), keepdims=True)
    scale = 1.0 if is_depth else 255.0
    return {name: value if name == "count" else np.squeeze(value / scale, axis=0) for name, value in stats.items()}


def numeric_stats(columns: Mapping[str, np.ndarray], features: Features) -> Stats:
    """Statistics of one episode's numeric columns, as LeRobot computes them, and of its microphones.

    Args:
        columns: (N, ...) per feature.
        features: LeRobot features of these columns.
    """
    others = {key: value for key, value in columns.items() if not key.startswith(AUDIO_PREFIX)}
    stats = compute_stats.compute_episode_stats(others, dict(features)) if others else {}
    return {**stats, **{key: sound_stats(columns[key].reshape(len(columns[key]), -1)) for key in audio_keys(columns)}}


def stats_columns(stats: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, list]:
    """An episode's statistics as the columns of its row in `meta/episodes`."""
    return {f"stats/{key}/{name}": value.tolist() for key, own in stats.items() for name, value in own.items()}


def row_stats(row: Mapping[str, Any]) -> Stats:
    """The statistics in an episode's row of `meta/episodes`, without those that are missing."""
    stats: Stats = {}
    for column, value in row.items():
        if column.startswith("stats/") and column.count("/") > 1 and value is not None:
            key, name = column.removeprefix("stats/").rsplit("/", 1)
            stats.setdefault(key, {})[name] = np.atleast_1d(np.array(value))
    return stats


def add_stats(total: Stats | None, episodes: Iterable[Stats]) -> Stats:
    """The statistics of a dataset after more episodes, aggregated by LeRobot."""
    parts = [*([total] if total else []), *episodes]
    summed: Stats = compute_stats.aggregate_stats(parts) if parts else {}
    for key in audio_keys(summed):
        for name, value in summed[key].items():
            if name != "count" and (value == value.flat[0]).all():
                summed[key][name] = np.full(value.shape, _rounded(float(value.flat[0])))
    return summed


def write_stats(stats: Stats, root: Path) -> None:
    """Writes `meta/stats.json` as LeRobot does, but each feature on one line: vectors of thousands take less room."""
    narrow = json.JSONEncoder(separators=(",", ":"))
    lines = [f"{json.dumps(key)}: {narrow.encode(value)}" for key, value in serialize_dict(stats).items()]
    (root / STATS_PATH).write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _rounded(value: float) -> float:
    """To five significant digits."""
    return float(f"{value:.5g}")
