"""Checks of a dataset's shape: what the survey found, lengths, sample rates, numbers and their statistics."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.findings import Finding, name_episodes
from lerobot_playbyear.datasets.frame_rate import sample_rate_of
from lerobot_playbyear.datasets.info import STATS_PATH, parse_stats
from lerobot_playbyear.datasets.reader import EpisodeRows, SurveyedDataset
from lerobot_playbyear.datasets.remedies import recompute_command

_LENGTH_FACTOR = 4.0  # an episode this much longer or shorter than the median is named
_STATS_TOLERANCE, _STD_TOLERANCE = 0.02, 0.05  # of a value's range, and of its standard deviation
_ROUNDING = 2.0**-23  # for each number in a sum: LeRobot sums values and their squares in float32, episode by episode


def check_structure(dataset: SurveyedDataset) -> Iterator[Finding]:
    """All checks below but that of sample rates."""
    for check in (check_survey, check_columns, check_lengths, check_finite_numbers, check_statistics):
        yield from check(dataset)


def check_survey(dataset: SurveyedDataset) -> Iterator[Finding]:
    """Files, rows, times and tasks: what is wrong with the episodes that are looked at."""
    every, asked = dataset.survey.findings, dataset.chosen
    found = [each for each in every if not each.episodes or asked is None or asked & set(each.episodes)]
    yield from found
    if not any(finding.check in ("files", "rows", "info") for finding in found):
        message = f"{len(dataset.episodes)} episodes, {len(dataset):,} frames, none missing"
        yield Finding("rows", "ok", message, figures={"episodes": len(dataset.episodes), "frames": len(dataset)})
    if not any(finding.check == "times" for finding in found):
        yield Finding("times", "ok", f"frames are 1/{dataset.fps} s apart in every episode")


def check_columns(dataset: SurveyedDataset) -> Iterator[Finding]:
    """Every column of numbers or sound can be read; the other checks leave those out that cannot."""
    for key, reason in dataset.unreadable.items():
        yield Finding("columns", "error", reason, key)
    if not dataset.unreadable:
        yield Finding("columns", "ok", "all can be read")


def check_lengths(dataset: SurveyedDataset) -> Iterator[Finding]:
    """Episodes are of a usable and comparable length."""
    lengths = np.array([len(episode) for episode in dataset.episodes])
    seconds = lengths / dataset.fps
    median = float(np.median(lengths))
    least, usual, most, total = float(seconds.min()), median / dataset.fps, float(seconds.max()), float(seconds.sum())
    figures = {"shortest_s": least, "median_s": usual, "longest_s": most, "total_s": total}
    text = f"{least:.4g} to {most:.4g} s, median {usual:.4g} s"
    single = [e.index for e in dataset.episodes if len(e) < 2]
    odd = [e.index for e in dataset.episodes if not median / _LENGTH_FACTOR <= len(e) <= median * _LENGTH_FACTOR]
    wrong = single or odd
    if wrong:
        reason = "a single frame" if single else f"over {_LENGTH_FACTOR:g} times shorter or longer than the median"
        text = f"{name_episodes(wrong)}: {reason}; {text}"
    yield Finding("episode lengths", "warning" if wrong else "ok", text, episodes=wrong, figures=figures)


def check_sample_rates(dataset: SurveyedDataset) -> Iterator[Finding]:
    """Each microphone's rows hold sample_rate / fps samples; where they cannot, the survey says so."""
    if not dataset.microphones:
        yield Finding("sound", "info", "no sound: no key starts with observation.audio.")
    for key in dataset.timed_microphones:
        block = dataset.features[key]["shape"][0]
        rate = sample_rate_of(block, dataset.fps)
        message = f"{rate:,} Hz / {dataset.fps} Hz = {block} samples per frame"
        yield Finding("sample rate", "ok", message, key, figures={"sample_rate": rate, "samples_per_frame": block})


def check_finite_numbers(dataset: SurveyedDataset) -> Iterator[Finding]:
    """No NaN and no infinite value in any column of floats."""
    n_columns, is_finite = 0, True
    for key in _readable(dataset):
        if _rows(dataset, key, dataset.episodes[0]).dtype.kind != "f":
            continue
        n_columns += 1
        bad = [int((~np.isfinite(_rows(dataset, key, each)).all(axis=1)).sum()) for each in dataset.episodes]
        if n_bad := sum(bad):
            is_finite = False
            episodes = [each.index for each, own in zip(dataset.episodes, bad, strict=True) if own]
            message = f"NaN or infinite in {n_bad} frames ({name_episodes(episodes)})"
            yield Finding("finite numbers", "error", message, key, episodes, {"frames": n_bad})
    if is_finite:
        yield Finding("finite numbers", "ok", f"no NaN and no infinite value in {n_columns} columns of floats")


def check_statistics(dataset: SurveyedDataset) -> Iterator[Finding]:
    """meta/stats.json, with which training normalises, describes the data that is there."""
    if len(dataset.episodes) != len(dataset.survey.episodes):
        yield Finding("statistics", "info", "not compared: only some of the episodes were opened")
        return
    stats, wrong, missing, n_compared = _stored_stats(dataset), [], [], 0
    for key in _readable(dataset):
        if key not in stats:
            missing.append(key)
            continue
        difference = _stats_difference(dataset, key, stats[key])
        n_compared += 1
        if difference:
            wrong.append(f"{key} ({difference})")
    remedy = f"Recompute them: {recompute_command(dataset.root)}"
    if wrong:
        yield Finding("statistics", "error", f"meta/stats.json does not fit the data: {'; '.join(wrong)}. {remedy}")
    if missing:
        yield Finding("statistics", "warning", f"meta/stats.json lacks {', '.join(missing)}. {remedy}")
    if not wrong and not missing:
        yield Finding("statistics", "ok", f"meta/stats.json fits the data of {n_compared} columns")


def _readable(dataset: SurveyedDataset) -> list[str]:
    return [*dataset.numbers, *(key for key in dataset.microphones if key not in dataset.unreadable)]


def _rows(dataset: SurveyedDataset, key: str, episode: EpisodeRows) -> np.ndarray:
    """(n, D)"""
    return dataset.values(key, episode).reshape(len(episode), -1)


def _stored_stats(dataset: SurveyedDataset) -> dict[str, dict[str, Any]]:
    """Empty where they cannot be read, which the survey says."""
    try:
        return parse_stats((dataset.root / STATS_PATH).read_bytes())
    except (OSError, ValueError):
        return {}


def _stats_difference(dataset: SurveyedDataset, key: str, own: Mapping[str, Any]) -> str | None:
    """What differs, in words.

    Statistics are per element, or one number for all elements of a row, given once or repeated for each. Those of sound
    are compared as statistics of all samples: where a sample stands in its row means nothing, and merging datasets
    averages both kinds.
    """
    found = _summarise(dataset, key)
    if found is None:
        return None  # a finding of its own
    size = found["min"].size
    stored: dict[str, np.ndarray] = {}
    for name in ("min", "max", "mean", "std"):
        if name not in own:
            return f"no {name}"
        stored[name] = np.asarray(own[name], np.float64).reshape(-1)
        if stored[name].size not in (1, size):
            return f"{name} has {stored[name].size} values for {size} elements"
    stored = _of_all_elements(stored) if key in dataset.microphones else stored
    for name, value in stored.items():
        value = value[:1] if (value == value[0]).all() else value
        compared = found if value.size == size else _of_all_elements(found)
        actual, rounding = compared[name], _ROUNDING * max(8, *map(len, dataset.episodes))
        squares = np.square(compared["mean"]) + np.square(compared["std"])
        tolerance = _STATS_TOLERANCE * (compared["max"] - compared["min"]) + rounding * np.sqrt(squares)
        if name == "std":  # a small difference of two large numbers
            tolerance = _STD_TOLERANCE * actual + np.sqrt(np.square(actual) + rounding * squares) - actual
        fits = np.abs(value - actual) <= tolerance + 1e-6 * (1 + np.abs(actual))  # false where it is NaN
        if not fits.all():
            element = int(np.flatnonzero(~fits)[0])
            return f"{name}[{element}] is {value[element]:.4g} there, {actual[element]:.4g} in the data"
    return None


def _summarise(dataset: SurveyedDataset, key: str) -> dict[str, np.ndarray] | None:
    """Least, largest, mean and standard deviation of each element of a column, (D,); None if a value is not finite."""
    n, low, high, mean, squares = 0, np.array(np.inf), np.array(-np.inf), np.array(0.0), np.array(0.0)
    for episode in dataset.episodes:
        values = _rows(dataset, key, episode).astype(np.float64)  # (k, D)
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


# What a report says of the dataset itself


def facts(dataset: SurveyedDataset) -> dict[str, Any]:
    """What the dataset is, for the head of a report."""
    rates = {key: (dataset.features[key].get("info") or {}).get("sample_rate") for key in dataset.microphones}
    return {
        "repo_id": dataset.repo_id,
        "root": str(dataset.root),
        "robot_type": dataset.info.get("robot_type"),
        "fps": dataset.fps,
        "episodes": len(dataset.episodes),
        "frames": len(dataset),
        "seconds": len(dataset) / dataset.fps,
        "cameras": {key: list(dataset.features[key]["shape"]) for key in dataset.cameras},
        "microphones": rates,
        "tasks": sorted({dataset.task(episode) for episode in dataset.episodes}),
    }


def finite(value: Any) -> Any:
    """The same for JSON, which has no NaN and no infinite numbers, though Python reads them in one: null for each."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, list | tuple) else value
