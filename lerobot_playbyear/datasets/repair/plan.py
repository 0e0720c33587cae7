"""What a repair will do: it follows from the survey alone, and nothing is read or written here."""

import bisect
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from lerobot.datasets.utils import INFO_PATH, DatasetInfo

from lerobot_playbyear.datasets.repair.episodes import Row
from lerobot_playbyear.datasets.repair.frames import Run
from lerobot_playbyear.datasets.repair.survey import Survey


@dataclass(frozen=True)
class Kept:
    """An episode that stays, or becomes, part of the dataset.

    Args:
        number: The episode's number from now on.
        first_index: The number of its first frame from now on.
        run: Where its frames are.
        row: Its row in `meta/episodes`; without a length, what is known of it, and the rest is made anew.
    """

    number: int
    first_index: int
    run: Run
    row: Row

    @property
    def has_row(self) -> bool:
        """Whether its row is right, but for the numbers that change."""
        return "length" in self.row

    @property
    def frames_stay(self) -> bool:
        """Whether none of the numbers in its frames changes."""
        return self.run.is_numbered and self.number == self.run.episode and self.first_index == self.run.first_index


@dataclass(frozen=True)
class Plan:
    """What a repair will do.

    Args:
        survey: What it follows from.
        kept: The episodes that are kept, in the order of their new numbers.
        info: What the repaired dataset says about itself.
        tables_stay: Whether the tables of episodes stay as they are.
        notes: What will be other than it was, as far as it is known before.
    """

    survey: Survey
    kept: list[Kept]
    info: DatasetInfo
    tables_stay: bool
    notes: list[str]


def make_plan(survey: Survey) -> Plan:
    """Keeps every whole episode: those after one that is lost move up. Everything that is right stays as it is.

    The report of the survey says then which are kept, and which are not.
    """
    kept: list[Kept] = []
    first_index = 0
    for episode in survey.episodes:
        if episode.run is not None:
            kept.append(Kept(len(kept), first_index, episode.run, episode.row))
            first_index += episode.run.length
    survey.report.kept = {one.run.episode: one.number for one in kept}
    survey.report.dropped = {episode.number: episode.reason for episode in survey.episodes if not episode.run}
    splits, notes = _moved_splits(survey.info, [one.run.episode for one in kept])
    info = replace(
        survey.info,
        total_episodes=len(kept),
        total_frames=first_index,
        total_tasks=len(survey.tasks.table),
        splits=splits,
    )
    tables_stay = (
        survey.tables_are_right and not survey.report.dropped and all(one.has_row and one.frames_stay for one in kept)
    )
    return Plan(survey, kept, info, tables_stay, notes)


def _moved_splits(info: DatasetInfo, kept: Sequence[int]) -> tuple[dict[str, Any], list[str]]:
    """The splits, which are ranges of episodes, in the episodes' new numbers; and what is other than it was."""
    splits = info.splits if isinstance(info.splits, dict) else {}
    n_before = info.total_episodes
    ranges = {name: _range(split, n_before) for name, split in splits.items()}
    if not splits or (
        len(splits) == 1 and (only := next(iter(ranges.values()))) and only[0] == 0 and only[1] >= n_before
    ):
        return dict.fromkeys(splits or ["train"], f"0:{len(kept)}"), []  # as LeRobot counts on
    moved: dict[str, Any] = {}
    notes: list[str] = []
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
    return moved, notes


def _range(split: Any, n_episodes: int) -> tuple[int, int] | None:
    ends = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", split) if isinstance(split, str) else None
    return (int(ends[1] or 0), int(ends[2] or n_episodes)) if ends else None
