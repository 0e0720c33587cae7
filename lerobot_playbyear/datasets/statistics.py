"""A microphone's statistics: a few numbers per episode, in the shape that LeRobot's tools want.

LeRobot keeps minimum, maximum, mean, standard deviation and quantiles of every element of a feature, which for sound
means per sample index: 0.1 to 0.3 MB per episode that say the same thing thousands of times, since a sample's place
within a frame means nothing. LeRobot's appending and merging stack the statistics of episodes and datasets, so their
shape (S,) has to stay. Here every entry of such a vector is the statistic of all samples: parquet stores the
repetition in a few bytes, and whoever reads it sees what LeRobot would have written, without the noise.
"""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats, get_feature_stats
from lerobot.datasets.io_utils import cast_stats_to_numpy
from lerobot.datasets.utils import STATS_PATH, serialize_dict

from lerobot_playbyear.datasets.audio_feature import audio_keys

Stats = dict[str, dict[str, np.ndarray]]
"""Per feature and statistic, as LeRobot keeps them."""

_DIGITS = 5  # significant ones


def sound_stats(waveform: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of all samples of a microphone's frames, each repeated to the shape (S,).

    Args:
        waveform: (N, S), the samples of N frames.
    """
    n_frames, n_samples = waveform.shape
    pooled = get_feature_stats(waveform.astype(np.float64).reshape(-1, 1), axis=0, keepdims=False)
    stats = {name: np.full(n_samples, _rounded(float(value[0]))) for name, value in pooled.items()}
    return {**stats, "count": np.array([n_frames])}


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


def with_sound_stats(row: pa.Table, sound: Mapping[str, Mapping[str, np.ndarray]]) -> pa.Table:
    """One episode's row of `meta/episodes`, with the statistics of its microphones."""
    for key, stats in sound.items():
        for name, value in stats.items():
            row = row.append_column(f"stats/{key}/{name}", pa.array([value.tolist()]))
    return row


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


def read_stats(root: Path) -> Stats | None:
    """A dataset's statistics; None where there are none.

    Raises:
        ValueError: The file is damaged.
    """
    path = root / STATS_PATH
    return cast_stats_to_numpy(json.loads(path.read_text())) if path.exists() else None


def write_stats(stats: Stats, root: Path) -> None:
    """Writes `meta/stats.json` as LeRobot does, but each feature on one line: vectors of thousands take less room."""
    lines = [f"{json.dumps(key)}: {_dump(value)}" for key, value in serialize_dict(stats).items()]
    path = root / STATS_PATH
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _rounded(value: float) -> float:
    if value == 0 or not math.isfinite(value):
        return value
    return round(value, _DIGITS - 1 - math.floor(math.log10(abs(value))))
