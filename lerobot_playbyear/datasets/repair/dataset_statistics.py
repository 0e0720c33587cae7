"""The statistics of a dataset, `meta/stats.json`: what is right stays as it is, and what is made anew is named."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from lerobot.datasets.io_utils import cast_stats_to_numpy
from lerobot.datasets.utils import STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.files import read_listed
from lerobot_playbyear.datasets.repair.episode_tables import Row
from lerobot_playbyear.datasets.repair.report import RepairReport
from lerobot_playbyear.datasets.statistics import Stats, add_stats, row_stats

_TOLERANCE = 0.01  # between statistics that were added up episode by episode and all at once


def read_own_stats(
    report: RepairReport, features: Mapping[str, Any], is_begun: bool
) -> dict[str, dict[str, np.ndarray] | None] | None:
    """Reads `meta/stats.json`.

    Args:
        report: Of the dataset; what is wrong is added.
        features: The dataset's.
        is_begun: Whether it has only been begun, and may have no statistics yet.

    Returns:
        Its entry for each feature, or None for a wrong one; None where the file is lost.

    Raises:
        OSError: It cannot be read now.
    """
    data = read_listed(report.root, STATS_PATH)
    if data is None:
        report.findings += [] if is_begun else [f"{STATS_PATH} is missing"]
        return None
    try:
        stats = cast_stats_to_numpy(json.loads(data))
        entries = {key: own if _are_numbers(own) else None for key, own in stats.items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        report.findings.append(f"{STATS_PATH} cannot be read: {error}")
        return None
    report.findings += [
        f"{STATS_PATH}: the entries of '{key}' are no numbers of shape {tuple(features.get(key, {}).get('shape', ()))}"
        for key, own in entries.items()
        if own is None
    ]
    return entries


def _are_numbers(own: Any) -> bool:
    return isinstance(own, dict) and all(value.dtype.kind in "fiub" for value in own.values())


def settle_stats(
    own: Mapping[str, dict[str, np.ndarray] | None] | None,
    info: DatasetInfo,
    rows: Sequence[Row],
    rows_before: Sequence[Row],
) -> tuple[Stats | None, list[str]]:
    """The statistics of the repaired dataset.

    An entry that describes as many frames as there still are stays. Of the others, values that were never those of
    the episodes, set by hand, stay too; the rest is added up anew.

    Args:
        own: The dataset's, as `read_own_stats` has them.
        info: What it says about itself.
        rows: The rows of the kept episodes, with their statistics.
        rows_before: All rows that there were.

    Returns:
        The statistics, or None if the file can stay as it is; and what is other than it was.
    """
    microphones = audio_keys(info.features)
    made = add_stats(None, [row_stats(row) for row in rows], microphones)
    if own is None:
        return made, [f"{STATS_PATH}: made anew from the episodes; what it held that is not theirs is lost"]
    before: Stats = {}
    with contextlib.suppress(ValueError, TypeError, AttributeError, KeyError):  # of rows that may be damaged
        before = add_stats(None, [row_stats(row) for row in rows_before], microphones)
    settled: Stats = dict(made)
    anew: list[str] = []
    by_hand: list[str] = []
    for key, entry in own.items():
        if entry is None:
            continue
        if key not in made or _alike(entry.get("count"), made[key].get("count")):
            settled[key] = entry
            by_hand += [] if key in info.features else [f"'{key}'"]
            continue
        set_by_hand = _set_by_hand(entry, before.get(key, {}))
        kept = {name: value for name, value in entry.items() if name in set_by_hand or name not in made[key]}
        settled[key] = {**made[key], **kept}
        by_hand += [f"{name} of '{key}'" for name in kept]
        anew.append(key)
    anew += [key for key in made if own.get(key) is None]
    notes = []
    if anew:
        notes.append(f"{STATS_PATH}: made anew from the episodes: {', '.join(sorted(anew))}")
        if by_hand:
            notes.append(f"{STATS_PATH}: not those of the episodes, and as they were: {', '.join(by_hand)}")
    return (settled if anew or None in own.values() else None), notes


def _set_by_hand(own: Mapping[str, np.ndarray], before: Mapping[str, np.ndarray]) -> set[str]:
    """Which statistics differ from those that the episodes add up to."""
    if not _alike(own.get("count"), before.get("count")):
        return set()  # they are older than the last episodes: nothing can be said
    return {name for name, value in own.items() if name in before and not _alike(value, before[name])}


def _alike(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    if one is None or other is None or one.shape != other.shape:
        return one is other
    one, other = one.astype(float), other.astype(float)
    return np.allclose(
        one, other, rtol=_TOLERANCE, atol=1e-6 * max(1.0, float(np.abs(other).max(initial=0))), equal_nan=True
    )
