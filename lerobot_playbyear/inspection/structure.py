"""Checks of a dataset's shape: what the survey found, lengths, sample rates, numbers and their statistics."""

from collections.abc import Iterator

import numpy as np

from lerobot_playbyear.datasets.features import check_audio_features
from lerobot_playbyear.datasets.findings import Finding, name_episodes
from lerobot_playbyear.inspection.source import DatasetSource

_LENGTH_FACTOR = 4.0  # an episode this much longer or shorter than the median is named
_STATS_TOLERANCE = 0.02  # of a value's range; LeRobot sums statistics in float32, episode by episode


def check_survey(source: DatasetSource) -> Iterator[Finding]:
    """Files, rows, times and tasks: what is wrong with the episodes that are looked at."""
    asked = source.chosen
    found = [
        each for each in source.survey.findings if not each.episodes or asked is None or asked & set(each.episodes)
    ]
    yield from found
    if not any(finding.check in ("files", "rows", "info") for finding in found):
        message = f"{len(source.episodes)} episodes, {len(source):,} frames, none missing"
        yield Finding("rows", "ok", message, figures={"episodes": len(source.episodes), "frames": len(source)})
    if not any(finding.check == "times" for finding in found):
        yield Finding("times", "ok", f"frames are 1/{source.fps} s apart in every episode")


def check_columns(source: DatasetSource) -> Iterator[Finding]:
    """Every column of numbers or sound can be read; the other checks leave those out that cannot."""
    for key, reason in source.unreadable.items():
        message = f"cannot be read: {reason}. Record these episodes again, or leave them out with --dataset.episodes"
        yield Finding("columns", "error", message, key)
    if not source.unreadable:
        yield Finding("columns", "ok", "all can be read")


def check_lengths(source: DatasetSource) -> Iterator[Finding]:
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
        yield Finding("episode lengths", "warning", message, episodes=single, figures=figures)
    elif odd:
        message = f"{name_episodes(odd)}: over {_LENGTH_FACTOR:g} times shorter or longer than the median; {text}"
        yield Finding("episode lengths", "warning", message, episodes=odd, figures=figures)
    else:
        yield Finding("episode lengths", "ok", text, figures=figures)


def check_sample_rates(source: DatasetSource) -> Iterator[Finding]:
    """Each microphone's rows hold sample_rate / fps samples; where they cannot, the survey says so."""
    if not source.microphones:
        yield Finding("sound", "info", "no sound: no key starts with observation.audio.")
    for key in fit_microphones(source):
        block = source.features[key]["shape"][0]
        rate = block * source.fps
        message = f"{rate:,} Hz / {source.fps} Hz = {block} samples per frame"
        yield Finding("sample rate", "ok", message, key, figures={"sample_rate": rate, "samples_per_frame": block})


def fit_microphones(source: DatasetSource) -> list[str]:
    """The microphones whose rows are what their sample rate says; of the others no moment in time is known."""
    fitting = []
    for key in source.microphones:
        try:
            check_audio_features({key: source.features[key]}, source.fps)
        except ValueError:
            continue
        if key not in source.unreadable:
            fitting.append(key)
    return fitting


def check_finite_numbers(source: DatasetSource) -> Iterator[Finding]:
    """No NaN and no infinite value in any column of floats."""
    n_columns, is_finite = 0, True
    for key in _readable(source):
        if source.block(key, source.episodes[0]).dtype.kind != "f":
            continue
        n_columns += 1
        bad = {each.index: int((~np.isfinite(source.block(key, each)).all(axis=1)).sum()) for each in source.episodes}
        if n_bad := sum(bad.values()):
            is_finite = False
            episodes = [episode for episode, own in bad.items() if own]
            message = f"NaN or infinite in {n_bad} frames ({name_episodes(episodes)})"
            yield Finding("finite numbers", "error", message, key, episodes, {"frames": n_bad})
    if is_finite:
        yield Finding("finite numbers", "ok", f"no NaN and no infinite value in {n_columns} columns of floats")


def check_statistics(source: DatasetSource) -> Iterator[Finding]:
    """meta/stats.json, with which training normalises, describes the data that is there."""
    if len(source.episodes) != len(source.survey.episodes):
        yield Finding("statistics", "info", "not compared: only some of the episodes were opened")
        return
    wrong, missing, n_compared = [], [], 0
    for key in _readable(source):
        if key not in source.stats:
            missing.append(key)
            continue
        difference = _stats_difference(source, key)
        n_compared += 1
        if difference:
            wrong.append(f"{key} ({difference})")
    remedy = "Recompute: lerobot-edit-dataset --operation.type recompute_stats"
    if wrong:
        yield Finding("statistics", "error", f"meta/stats.json does not fit the data: {'; '.join(wrong)}. {remedy}")
    if missing:
        yield Finding("statistics", "warning", f"meta/stats.json lacks {', '.join(missing)}. {remedy}")
    if not wrong and not missing:
        yield Finding("statistics", "ok", f"meta/stats.json fits the data of {n_compared} columns")


def _readable(source: DatasetSource) -> list[str]:
    return [*source.numbers, *(key for key in source.microphones if key not in source.unreadable)]


def _stats_difference(source: DatasetSource, key: str) -> str | None:
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
        if name not in source.stats[key]:
            return f"no {name}"
        stored[name] = np.asarray(source.stats[key][name], np.float64).reshape(-1)
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
    for episode in source.episodes:
        values = source.block(key, episode).astype(np.float64)  # (k, D)
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
