"""The metadata of a repaired dataset: what is right stays as it is, and what is made anew is named."""

import bisect
import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.io_utils import cast_stats_to_numpy, write_json
from lerobot.datasets.utils import INFO_PATH, STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.audio_feature import audio_keys
from lerobot_playbyear.datasets.files import is_listed, naming
from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.info import own_info
from lerobot_playbyear.datasets.statistics import Stats, add_stats, row_stats

_TOLERANCE = 0.01  # between statistics that were added up episode by episode and all at once


def write_own_info(root: Path, target: Path, info: DatasetInfo, kept: Sequence[int], notes: list[str]) -> None:
    """Writes `meta/info.json` with all fields that it had, those of other tools as well.

    Args:
        root: The damaged dataset.
        target: The repaired one.
        info: What it says about itself; its splits are set.
        kept: The numbers that the kept episodes had, in order.
        notes: Gets what is other than it was.
    """
    splits = info.splits if isinstance(info.splits, dict) else {}
    info.splits = _moved_splits(splits, info.total_episodes, kept, notes)
    info.total_episodes = len(kept)
    write_json({**own_info(root), **info.to_dict()}, target / INFO_PATH)


def _moved_splits(splits: Mapping[str, Any], n_before: int, kept: Sequence[int], notes: list[str]) -> dict[str, Any]:
    """The splits, which are ranges of episodes, in the episodes' new numbers."""
    ranges = {name: _range(split, n_before) for name, split in splits.items()}
    if not splits or (
        len(splits) == 1 and (only := next(iter(ranges.values()))) and only[0] == 0 and only[1] >= n_before
    ):
        return dict.fromkeys(splits or ["train"], f"0:{len(kept)}")  # as LeRobot counts on
    moved: dict[str, Any] = {}
    for name, split in splits.items():
        own = ranges[name]
        moved[name] = split if own is None else ":".join(str(bisect.bisect_left(kept, end)) for end in own)
        if own is None and list(kept) != list(range(n_before)):
            notes.append(
                f"{INFO_PATH}: the split '{name}' stays {split!r}, which is no range: it may name other episodes"
            )
        elif own is not None and moved[name] != "{}:{}".format(*own):
            notes.append(
                f"{INFO_PATH}: the split '{name}' was {split}; in the episodes' new numbers it is {moved[name]}"
            )
        else:
            moved[name] = split
    return moved


def _range(split: Any, n_episodes: int) -> tuple[int, int] | None:
    ends = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", split) if isinstance(split, str) else None
    return (int(ends[1] or 0), int(ends[2] or n_episodes)) if ends else None


def read_own_stats(root: Path, features: Mapping[str, Any]) -> tuple[Stats | None, list[str]]:
    """The entries of `meta/stats.json` that are right, and what is wrong with the others.

    Raises:
        OSError: It cannot be read now.
    """
    if not is_listed(root, STATS_PATH):
        return None, ["is missing"]
    with naming(root / STATS_PATH):
        data = (root / STATS_PATH).read_bytes()
    try:
        stats = cast_stats_to_numpy(json.loads(data))
        wrong = [key for key, own in stats.items() if not _are_numbers(own)]
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        return None, [f"cannot be read: {error}"]
    problems = [
        f"the entries of '{key}' are no numbers of shape {tuple(features.get(key, {}).get('shape', ()))}"
        for key in wrong
    ]
    return {key: own for key, own in stats.items() if key not in wrong}, problems


def _are_numbers(own: Any) -> bool:
    return isinstance(own, dict) and all(value.dtype.kind in "fiub" for value in own.values())


def settle_stats(
    root: Path, info: DatasetInfo, rows: Sequence[Row], rows_before: Sequence[Row], notes: list[str]
) -> Stats | None:
    """The statistics of the repaired dataset.

    An entry that describes as many frames as there still are stays. Of the others, values that were never those of
    the episodes, set by hand, stay too; the rest is added up anew.

    Args:
        root: The damaged dataset.
        info: What it says about itself.
        rows: The rows of the kept episodes, with their statistics.
        rows_before: All rows that there were.
        notes: Gets what is other than it was.

    Returns:
        The statistics; None if the file can stay as it is.
    """
    microphones = audio_keys(info.features)
    made = add_stats(None, [row_stats(row) for row in rows], microphones)
    old, problems = read_own_stats(root, info.features)
    if old is None:
        notes.append(f"{STATS_PATH}: made anew from the episodes; what it held that is not theirs is lost")
        return made
    before: Stats = {}
    with contextlib.suppress(ValueError, TypeError, AttributeError, KeyError):  # of rows that may be damaged
        before = add_stats(None, [row_stats(row) for row in rows_before], microphones)
    settled: Stats = dict(made)
    anew: list[str] = []
    by_hand: list[str] = []
    for key, own in old.items():
        if key not in made or _alike(own.get("count"), made[key].get("count")):
            settled[key] = own
            by_hand += [] if key in info.features else [f"'{key}'"]
            continue
        set_by_hand = _set_by_hand(own, before.get(key, {}))
        kept = {name: value for name, value in own.items() if name in set_by_hand or name not in made[key]}
        settled[key] = {**made[key], **kept}
        by_hand += [f"{name} of '{key}'" for name in kept]
        anew.append(key)
    anew += [key for key in made if key not in old]
    if anew:
        notes.append(f"{STATS_PATH}: made anew from the episodes: {', '.join(sorted(anew))}")
        if by_hand:
            notes.append(f"{STATS_PATH}: not those of the episodes, and as they were: {', '.join(by_hand)}")
    return settled if anew or problems else None


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
