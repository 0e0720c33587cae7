"""What there is of a dataset, and what is wrong with it: everything that is read before a repair."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.episodes import (
    Episode,
    Row,
    check_counts,
    match_episodes,
    read_rows,
    with_lost,
    without_impossible_numbers,
)
from lerobot_playbyear.datasets.repair.frames import read_frames
from lerobot_playbyear.datasets.repair.info import check_rates, read_info, settle_features
from lerobot_playbyear.datasets.repair.report import DatasetDamagedError, RepairReport
from lerobot_playbyear.datasets.repair.statistics import read_own_stats
from lerobot_playbyear.datasets.repair.tasks import Tasks, settle_tasks
from lerobot_playbyear.datasets.repair.videos import check_videos


@dataclass(frozen=True)
class Survey:
    """A dataset as it was found.

    Args:
        report: What is not fine, but for the episodes, which say that themselves.
        info: What it says about itself, made good as far as that is proven.
        info_fields: Everything that its `meta/info.json` holds, also what LeRobot does not know.
        rows: All rows of its tables of episodes that can be read.
        tables_are_right: Whether these tables are.
        episodes: All episodes, in the order of their numbers, also those that are not whole.
        tasks: Its tasks.
        stats: The entries of its statistics, as `read_own_stats` has them.
    """

    report: RepairReport
    info: DatasetInfo
    info_fields: Mapping[str, Any]
    rows: Sequence[Row]
    tables_are_right: bool
    episodes: Sequence[Episode]
    tasks: Tasks
    stats: Mapping[str, dict[str, np.ndarray] | None] | None


def survey(root: Path, *, fps: int | None, features: dict[str, dict] | None, thorough: bool) -> Survey:
    """Reads a dataset, and changes nothing.

    Args:
        root: Its folder.
        fps: Its frames per second, if the caller knows them.
        features: Its features, if the caller knows them.
        thorough: Read everything, with checksums, and decode all pictures.

    Raises:
        DatasetDamagedError: It is no dataset, or too damaged to say what it holds.
        OSError: Something cannot be read now, which says nothing about the dataset.
        MemoryError: There is no room for something.
    """
    if not root.is_dir():
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: it is no folder.")
    report = RepairReport(root)
    info, fields = read_info(report, fps, features)
    info = settle_features(report, info, features)
    runs, frame_seconds = read_frames(report, info, thorough)
    rate = check_rates(report, info, frame_seconds)
    n_before = len(report.findings)
    all_rows = read_rows(report)
    runs, rows = without_impossible_numbers(report, runs, all_rows)
    tables_are_right = len(report.findings) == n_before
    episodes = match_episodes(report, runs, rows, info)
    first_rows = {row["episode_index"]: row for row in reversed(all_rows)}
    tasks = settle_tasks(report, episodes, first_rows)
    checked = check_videos(report, info, rate, with_lost(info, episodes), first_rows, thorough)
    check_counts(report, info, checked)
    stats = read_own_stats(report, info.features, is_begun=not any(episode.run for episode in checked))
    return Survey(report, info, fields, all_rows, tables_are_right, checked, tasks, stats)
