"""Checks of a dataset's shape: rows, times, lengths, sample rates, numbers and their statistics."""

from collections.abc import Iterator

import numpy as np

from lerobot_playbyear.datasets.features import check_audio_features
from lerobot_playbyear.inspection.source import DatasetSource, Episode
from lerobot_playbyear.inspection.verdict import Verdict, name_episodes

_TIME_TOLERANCE_S = 1e-3
_LENGTH_FACTOR = 4.0  # an episode this much longer or shorter than the median is named
_STATS_TOLERANCE = 0.02  # of a value's range; LeRobot sums statistics in float32, episode by episode


def check_columns(source: DatasetSource) -> Iterator[Verdict]:
    """Every column of numbers or sound can be read; the other checks leave those out that cannot."""
    for key, reason in source.unreadable.items():
        message = f"cannot be read: {reason}. Record these episodes again, or leave them out with --dataset.episodes"
        yield Verdict("columns", "error", message, key)
    if not source.unreadable:
        yield Verdict("columns", "ok", "all can be read")


def check_rows(source: DatasetSource) -> Iterator[Verdict]:
    """Every episode has frames 0 to n - 1, n / fps apart, and as many as the metadata says."""
    frame_index, timestamps = source.values("frame_index"), source.values("timestamp")
    incomplete, untimely = [], []
    for episode in source.episodes:
        expected = np.arange(len(episode))
        if not np.array_equal(frame_index[episode.rows], expected) or not _is_whole(source, episode):
            incomplete.append(episode.index)
        elif np.abs(timestamps[episode.rows] - expected / source.fps).max() > _TIME_TOLERANCE_S:
            untimely.append(episode.index)
    total = source.dataset.meta.total_frames
    if incomplete:
        message = f"{name_episodes(incomplete)}: frames are missing, or are not those that the metadata names"
        yield Verdict("rows", "error", message, episodes=incomplete)
    elif len(source.episodes) == source.dataset.meta.total_episodes and len(source) != total:
        yield Verdict("rows", "error", f"{len(source):,} frames, but meta/info.json says {total:,}")
    else:
        message = f"{len(source.episodes)} episodes, {len(source):,} frames, none missing"
        yield Verdict("rows", "ok", message, figures={"episodes": len(source.episodes), "frames": len(source)})
    if untimely:
        message = f"{name_episodes(untimely)}: timestamps are not frame / fps at {source.fps} frames per second"
        yield Verdict("times", "error", message, episodes=untimely)
    else:
        yield Verdict("times", "ok", f"frames are 1/{source.fps} s apart in every episode")


def check_lengths(source: DatasetSource) -> Iterator[Verdict]:
    """Episodes are of a usable and comparable length."""
    lengths = np.array([len(episode) for episode in source.episodes])
    seconds = lengths / source.fps
    median = float(np.median(lengths))
    figures = {
        "shortest_s": float(seconds.min()),
        "median_s": median / source.fps,
        "longest_s": float(seconds.max()),
        "total_s": float(seconds.sum()),
    }
    text = f"{seconds.min():.4g} to {seconds.max():.4g} s, median {median / source.fps:.4g} s"
    single = [e.index for e in source.episodes if len(e) < 2]
    odd = [e.index for e in source.episodes if not median / _LENGTH_FACTOR <= len(e) <= median * _LENGTH_FACTOR]
    if single:
        message = f"{name_episodes(single)}: a single frame; {text}"
        yield Verdict("episode lengths", "warning", message, episodes=single, figures=figures)
    elif odd:
        message = f"{name_episodes(odd)}: over {_LENGTH_FACTOR:g} times shorter or longer than the median; {text}"
        yield Verdict("episode lengths", "warning", message, episodes=odd, figures=figures)
    else:
        yield Verdict("episode lengths", "ok", text, figures=figures)


def check_sample_rates(source: DatasetSource) -> Iterator[Verdict]:
    """Each microphone's rows hold sample_rate / fps samples."""
    if not source.microphones:
        yield Verdict("sound", "info", "no sound: no key starts with observation.audio.")
    for key in source.microphones:
        try:
            rate = _sample_rate(source, key)
        except ValueError as error:
            yield Verdict("sample rate", "error", str(error).removeprefix(f"'{key}' "), key)
        else:
            block = rate // source.fps
            message = f"{rate:,} Hz / {source.fps} Hz = {block} samples per frame"
            yield Verdict("sample rate", "ok", message, key, figures={"sample_rate": rate, "samples_per_frame": block})


def fit_microphones(source: DatasetSource) -> list[str]:
    """The microphones whose rows are what their sample rate says; of the others no moment in time is known."""
    return [key for key in source.microphones if _fits(source, key)]


def check_finite_numbers(source: DatasetSource) -> Iterator[Verdict]:
    """No NaN and no infinite value in any column of floats."""
    n_columns = 0
    for key in _readable(source, *source.numbers, *source.microphones, "timestamp"):
        bad = _bad_rows(source, key)
        if bad is None:
            continue
        n_columns += 1
        if bad.any():
            episodes = [episode.index for episode in source.episodes if bad[episode.rows].any()]
            message = f"NaN or infinite in {int(bad.sum())} frames ({name_episodes(episodes)})"
            yield Verdict("finite numbers", "error", message, key, episodes, {"frames": int(bad.sum())})
            n_columns = -len(source.features)
    if n_columns >= 0:
        yield Verdict("finite numbers", "ok", f"no NaN and no infinite value in {n_columns} columns of floats")


def check_statistics(source: DatasetSource) -> Iterator[Verdict]:
    """meta/stats.json, with which training normalises, describes the data that is there."""
    stats = source.dataset.meta.stats or {}
    if len(source.episodes) != source.dataset.meta.total_episodes:
        yield Verdict("statistics", "info", "not compared: only some of the episodes were opened")
        return
    wrong, missing, n_compared = [], [], 0
    for key in _readable(source, *source.numbers, *source.microphones):
        if key not in stats:
            missing.append(key)
            continue
        difference = _stats_difference(source, key, stats[key])
        n_compared += 1
        if difference:
            wrong.append(f"{key} ({difference})")
    remedy = "Recompute: lerobot-edit-dataset --operation.type recompute_stats"
    if wrong:
        yield Verdict("statistics", "error", f"meta/stats.json does not fit the data: {'; '.join(wrong)}. {remedy}")
    if missing:
        yield Verdict("statistics", "warning", f"meta/stats.json lacks {', '.join(missing)}. {remedy}")
    if not wrong and not missing:
        yield Verdict("statistics", "ok", f"meta/stats.json fits the data of {n_compared} columns")


def _readable(source: DatasetSource, *keys: str) -> list[str]:
    return [key for key in keys if key not in source.unreadable]


def _sample_rate(source: DatasetSource, key: str) -> int:
    rate = check_audio_features({key: source.features[key]}, source.fps)[key]
    held = source.samples_per_frame(key)
    if held != rate // source.fps:
        raise ValueError(f"rows hold {held} samples, but {rate} Hz / {source.fps} Hz = {rate // source.fps}")
    return rate


def _fits(source: DatasetSource, key: str) -> bool:
    try:
        return _sample_rate(source, key) > 0
    except ValueError:
        return False


def _is_whole(source: DatasetSource, episode: Episode) -> bool:
    table = source.dataset.meta.episodes
    return episode.index < len(table) and int(table[episode.index]["length"]) == len(episode)


def _bad_rows(source: DatasetSource, key: str) -> np.ndarray | None:
    """Which rows of a column hold NaN or infinite values, (N,) bool; None for a column that is not of floats."""
    bad = np.zeros(len(source), bool)
    for first, values in source.pieces(key):
        if not np.issubdtype(values.dtype, np.floating):
            return None
        bad[first : first + len(values)] = ~np.isfinite(values).all(axis=1)
    return bad


def _stats_difference(source: DatasetSource, key: str, stats: dict[str, np.ndarray]) -> str | None:
    """What differs, in words.

    Statistics are per element, or one number for all elements of a row, given once or repeated for each. Those of sound
    are compared as statistics of all samples: where a sample stands in its row means nothing, and merging datasets
    averages both kinds.
    """
    found = _summarise(source, key)
    if found is None:
        return None  # a finding of its own
    size = found["min"].size
    stored: dict[str, np.ndarray] = {}
    for name in ("min", "max", "mean", "std"):
        if name not in stats:
            return f"no {name}"
        stored[name] = np.asarray(stats[name], np.float64).reshape(-1)
        if stored[name].size not in (1, size):
            return f"{name} has {stored[name].size} values for {size} elements"
    stored = _of_all_elements(stored) if key in source.microphones else stored
    for name, value in stored.items():
        value = value[:1] if (value == value[0]).all() else value
        compared = found if value.size == size else _of_all_elements(found)
        actual, scale = compared[name], compared["max"] - compared["min"]
        off = np.abs(value - actual) > _STATS_TOLERANCE * scale + 1e-6 * (1 + np.abs(actual))
        if off.any():
            element = int(np.flatnonzero(off)[0])
            return f"{name}[{element}] is {value[element]:.4g} there, {actual[element]:.4g} in the data"
    return None


def _summarise(source: DatasetSource, key: str) -> dict[str, np.ndarray] | None:
    """Least, largest, mean and standard deviation of each element of a column, (D,); None if a value is not finite."""
    n, low, high, mean, squares = 0, np.array(np.inf), np.array(-np.inf), np.array(0.0), np.array(0.0)
    for _, stored in source.pieces(key):
        values = stored.astype(np.float64)  # (k, D)
        if not np.isfinite(values).all():
            return None
        own, share = values.mean(axis=0), len(values) / (n + len(values))
        squares = squares + np.square(values - own).sum(axis=0) + np.square(own - mean) * n * share
        mean = mean + (own - mean) * share
        low, high, n = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0)), n + len(values)
    return {"min": low, "max": high, "mean": mean, "std": np.sqrt(squares / max(n, 1))}


def _of_all_elements(each: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same of all elements together, (1,)."""
    mean = each["mean"].mean()
    variance = (np.square(each["std"]) + np.square(each["mean"] - mean)).mean()
    together = {"min": each["min"].min(), "max": each["max"].max(), "mean": mean, "std": np.sqrt(variance)}
    return {name: np.atleast_1d(value) for name, value in together.items()}
