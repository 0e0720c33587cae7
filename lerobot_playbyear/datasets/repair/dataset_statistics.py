"""The statistics of a dataset, `meta/stats.json`: what is right stays as it is, and what is made anew is named."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.io_utils import cast_stats_to_numpy
from lerobot.datasets.utils import STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.files import read_listed
from lerobot_playbyear.datasets.repair.episode_tables import Row
from lerobot_playbyear.datasets.repair.findings import Finding, State, Thing
from lerobot_playbyear.datasets.statistics import Stats, add_stats, row_stats

_TOLERANCE = 0.01  # between statistics that were added up episode by episode and all at once


@dataclass(frozen=True)
class OwnStats:
    """The entries of `meta/stats.json` that are right.

    Args:
        entries: Per feature; None where the file is lost.
        findings: What is wrong with the others, or the file.
    """

    entries: Stats | None
    findings: tuple[Finding, ...]


def read_own_stats(root: Path, features: Mapping[str, Any]) -> OwnStats:
    """Reads `meta/stats.json`.

    Raises:
        OSError: It cannot be read now.
    """
    data = read_listed(root, STATS_PATH)
    if data is None:
        return OwnStats(None, (Finding(Thing.STATISTICS, State.MISSING, f"{STATS_PATH} is missing"),))
    try:
        stats = cast_stats_to_numpy(json.loads(data))
        wrong = [key for key, own in stats.items() if not _are_numbers(own)]
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        return OwnStats(None, (Finding(Thing.STATISTICS, State.DAMAGED, f"{STATS_PATH} cannot be read: {error}"),))
    problems = (
        f"{STATS_PATH}: the entries of '{key}' are no numbers of shape {tuple(features.get(key, {}).get('shape', ()))}"
        for key in wrong
    )
    return OwnStats(
        {key: own for key, own in stats.items() if key not in wrong},
        tuple(Finding(Thing.STATISTICS, State.DAMAGED, problem) for problem in problems),
    )


def _are_numbers(own: Any) -> bool:
    return isinstance(own, dict) and all(value.dtype.kind in "fiub" for value in own.values())


def settle_stats(
    own: OwnStats, info: DatasetInfo, rows: Sequence[Row], rows_before: Sequence[Row]
) -> tuple[Stats | None, list[str]]:
    """The statistics of the repaired dataset.

    An entry that describes as many frames as there still are stays. Of the others, values that were never those of
    the episodes, set by hand, stay too; the rest is added up anew.

    Args:
        own: The dataset's.
        info: What it says about itself.
        rows: The rows of the kept episodes, with their statistics.
        rows_before: All rows that there were.

    Returns:
        The statistics, or None if the file can stay as it is; and what is other than it was.
    """
    microphones = audio_keys(info.features)
    made = add_stats(None, [row_stats(row) for row in rows], microphones)
    if own.entries is None:
        return made, [f"{STATS_PATH}: made anew from the episodes; what it held that is not theirs is lost"]
    before: Stats = {}
    with contextlib.suppress(ValueError, TypeError, AttributeError, KeyError):  # of rows that may be damaged
        before = add_stats(None, [row_stats(row) for row in rows_before], microphones)
    settled: Stats = dict(made)
    anew: list[str] = []
    by_hand: list[str] = []
    for key, entry in own.entries.items():
        if key not in made or _alike(entry.get("count"), made[key].get("count")):
            settled[key] = entry
            by_hand += [] if key in info.features else [f"'{key}'"]
            continue
        set_by_hand = _set_by_hand(entry, before.get(key, {}))
        kept = {name: value for name, value in entry.items() if name in set_by_hand or name not in made[key]}
        settled[key] = {**made[key], **kept}
        by_hand += [f"{name} of '{key}'" for name in kept]
        anew.append(key)
    anew += [key for key in made if key not in own.entries]
    notes = []
    if anew:
        notes.append(f"{STATS_PATH}: made anew from the episodes: {', '.join(sorted(anew))}")
        if by_hand:
            notes.append(f"{STATS_PATH}: not those of the episodes, and as they were: {', '.join(by_hand)}")
    return (settled if anew or own.findings else None), notes


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
