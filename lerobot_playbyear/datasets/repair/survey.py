"""What there is of a dataset, and what is wrong with it: everything that is read before a repair."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.datasets.utils import DatasetInfo

from lerobot_playbyear.datasets.repair.dataset_statistics import OwnStats, read_own_stats
from lerobot_playbyear.datasets.repair.episode_tables import Row, read_rows
from lerobot_playbyear.datasets.repair.episodes import (
    Episode,
    check_counts,
    match_episodes,
    rows_by_number,
    with_lost,
)
from lerobot_playbyear.datasets.repair.features import settle_features
from lerobot_playbyear.datasets.repair.findings import DatasetDamagedError, Finding, State
from lerobot_playbyear.datasets.repair.frames import read_frames
from lerobot_playbyear.datasets.repair.info import check_rates, frame_rate, read_info
from lerobot_playbyear.datasets.repair.tasks import Tasks, read_tasks, settle_tasks
from lerobot_playbyear.datasets.repair.videos import check_videos


@dataclass(frozen=True)
class Survey:
    """A dataset as it was found.

    Args:
        info: What it says about itself, made good as far as that is proven.
        info_fields: Everything that its `meta/info.json` holds, also what LeRobot does not know.
        rows: All rows of its tables of episodes that can be read.
        episodes: All episodes, in the order of their numbers, also those that are not whole.
        tasks: Its tasks.
        stats: Its statistics.
        findings: All that is not fine, but for the episodes, which say that themselves.
    """

    info: DatasetInfo
    info_fields: Mapping[str, Any]
    rows: tuple[Row, ...]
    episodes: tuple[Episode, ...]
    tasks: Tasks
    stats: OwnStats
    findings: tuple[Finding, ...]


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
    info, fields, of_info = read_info(root, fps, features)
    info, of_features = settle_features(root, info, features)
    frames = read_frames(root, info, thorough)
    tables = read_rows(root)
    episodes, of_episodes = match_episodes(frames.runs, tables.rows, info)
    rows = rows_by_number(tables.rows)
    tasks = settle_tasks(read_tasks(root), episodes, rows)
    rate = frame_rate(info, frames.frame_seconds)
    episodes, of_videos = check_videos(root, info, rate, with_lost(info, episodes), rows, thorough)
    stats = read_own_stats(root, info.features)
    is_begun = not any(episode.is_whole for episode in episodes)  # it may have no statistics yet
    of_stats = [finding for finding in stats.findings if not (is_begun and finding.state is State.MISSING)]
    findings = (
        *of_info,
        *of_features,
        *frames.findings,
        *check_rates(info, frames.frame_seconds),
        *tables.findings,
        *of_episodes,
        *tasks.findings,
        *of_videos,
        *check_counts(info, episodes),
        *of_stats,
    )
    return Survey(info, fields, tables.rows, episodes, tasks, stats, findings)
