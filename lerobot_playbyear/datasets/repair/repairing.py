"""Finding out what is wrong with a dataset on disk, and putting it right beside the original."""

import contextlib
import itertools
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.journal import finish_journal, flush
from lerobot_playbyear.datasets.locking import DatasetLock, DatasetLockedError
from lerobot_playbyear.datasets.repair.copying import Kept, write_copy
from lerobot_playbyear.datasets.repair.episodes import (
    Row,
    choose_runs,
    plausible,
    read_rows,
    read_tasks,
    trusted_rows,
)
from lerobot_playbyear.datasets.repair.features import settle_features
from lerobot_playbyear.datasets.repair.frames import Run, read_frames
from lerobot_playbyear.datasets.repair.info import DatasetDamagedError, correct_rates, read_info
from lerobot_playbyear.datasets.repair.videos import check_videos
from lerobot_playbyear.datasets.statistics import read_stats

_MOST_EPISODES = 10_000  # that are believed to be lost; a larger number was misread


@dataclass
class RepairReport:
    """What was wrong with a dataset, and what became of it.

    Args:
        root: Its folder.
        findings: What was wrong, a line each; empty for a sound dataset.
        kept: Where each complete episode is now: its number before, and now.
        dropped: The episodes that are not complete: their number before, and why.
        original: Where the damaged dataset was put; None where nothing was changed.
    """

    root: Path
    findings: list[str] = field(default_factory=list)
    kept: dict[int, int] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)
    original: Path | None = None

    @property
    def is_sound(self) -> bool:
        """Whether nothing was wrong."""
        return not self.findings and not self.dropped

    @property
    def changed(self) -> bool:
        """Whether the dataset was repaired."""
        return self.original is not None

    def __str__(self) -> str:
        if self.is_sound:
            return f"{self.root}: {len(self.kept)} episodes, nothing wrong."
        lines = [f"{self.root} was damaged:" if self.changed else f"{self.root} is damaged:"]
        lines += [f"  - {finding}" for finding in self.findings]
        lines += [f"  - episode {number} is lost: {reason}" for number, reason in sorted(self.dropped.items())]
        lines.append(f"{'Kept' if self.changed else 'Can be kept'}: {len(self.kept)} complete episodes.")
        moved = {old: new for old, new in self.kept.items() if old != new}
        if moved:
            pairs = ", ".join(f"{old} is now {new}" for old, new in sorted(moved.items())[:20])
            lines.append(f"Numbered anew: {pairs}{' ...' if len(moved) > 20 else ''}.")
        if self.changed:
            lines.append(f"The damaged dataset is untouched in {self.original}; delete it when you no longer need it.")
        return "\n".join(lines)


@dataclass
class _Survey:
    info: DatasetInfo
    tasks: pd.DataFrame
    runs: dict[int, Run]
    rows: dict[int, Row]
    report: RepairReport


def check_dataset(
    root: str | Path, *, fps: int | None = None, features: dict[str, dict] | None = None, thorough: bool = True
) -> RepairReport:
    """Looks for damage in a local dataset, changing nothing. Arguments and errors as for `repair_dataset`."""
    return _survey(Path(root), fps, features, thorough).report


def repair_dataset(
    root: str | Path,
    *,
    fps: int | None = None,
    features: dict[str, dict] | None = None,
    thorough: bool = True,
    has_lock: bool = False,
) -> RepairReport:
    """Repairs a local dataset of ours or of LeRobot's; every complete episode is kept, bit for bit.

    A recording that was killed has lost its tables' ends, which are made anew from what is there; so are damaged or
    deleted tables in `meta/`. Where frames or pictures are lost, their episodes are dropped and those after them
    move up. The repaired dataset is written beside the damaged one and then takes its place.

    Args:
        root: The dataset's folder.
        fps: Its frames per second, if known; needed only where `meta/info.json` is lost.
        features: Its features, if known; needed only where `meta/info.json` is lost.
        thorough: Read everything, with checksums, and decode all pictures. Otherwise only what tells whether the
            dataset can be opened and continued: this takes seconds, whatever its size.
        has_lock: The caller is the one that writes to this dataset.

    Returns:
        What was found and done.

    Raises:
        DatasetDamagedError: It cannot be repaired, or no episode would be left. Nothing was changed.
        OSError: The repaired copy cannot be written. Nothing was changed.
    """
    root = Path(root)
    finish_repair(root)
    with contextlib.nullcontext() if has_lock else _lock(root):
        finish_journal(root)
        survey = _survey(root, fps, features, thorough)
        report = survey.report
        if report.is_sound:
            return report
        if not report.kept:
            raise DatasetDamagedError(f"{report}\nNo complete episode is left in {root}; nothing was changed.")
        copy = _copy_of(root)
        shutil.rmtree(copy, ignore_errors=True)  # of a repair that was killed
        try:
            copy.mkdir()
            write_copy(root, copy, survey.info, survey.tasks, _kept(survey))
            again = check_dataset(copy, thorough=False)
            if not again.is_sound:
                raise DatasetDamagedError(f"The repaired copy of {root} is not sound; nothing was changed. {again}")
            _flush_all(copy)
        except BaseException:
            shutil.rmtree(copy, ignore_errors=True)
            raise
        report.original = _unused(root)
        os.rename(root, report.original)
        os.rename(copy, root)
        flush(root.absolute().parent)
    return report


def _survey(root: Path, fps: int | None, features: dict[str, dict] | None, thorough: bool) -> _Survey:
    findings: list[str] = []
    reasons: dict[int, str] = {}
    if not root.is_dir():
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: it is no folder.")
    info = read_info(root, fps, features, findings)
    settle_features(root, info, features, findings)
    frames = read_frames(root, info, thorough, findings)
    correct_rates(info, frames.frame_seconds, findings)
    rows = read_rows(root, findings)
    rows, found = plausible(rows, frames.runs, findings)
    runs = choose_runs(found, rows, reasons)
    tasks = read_tasks(root, rows, runs, findings)
    rows = trusted_rows(rows, runs, info, findings)
    check_videos(root, info, runs, rows, thorough, reasons, findings)
    _check_counts(info, runs, reasons, findings)
    _check_stats(root, info, runs, findings)
    report = RepairReport(root, findings, {old: new for new, old in enumerate(sorted(runs))}, reasons)
    return _Survey(info, tasks, runs, rows, report)


def _check_counts(info: DatasetInfo, runs: dict[int, Run], reasons: dict[int, str], findings: list[str]) -> None:
    known = {*runs, *reasons}
    gone = [number for number in range(max(known, default=-1) + 1) if number not in known]
    reasons.update(dict.fromkeys(gone, "nothing is left of it"))
    count = max(known, default=-1) + 1
    if count < info.total_episodes < count + _MOST_EPISODES and info.total_frames != _n_frames(runs):
        reasons.update(dict.fromkeys(range(count, info.total_episodes), "nothing is left of it"))
    elif info.total_episodes != count or (not reasons and info.total_frames != _n_frames(runs)):
        findings.append(
            f"meta/info.json counts {info.total_episodes} episodes of {info.total_frames} frames in all; there are "
            f"{count} of {_n_frames(runs)}"
        )
    expected = 0
    for number in sorted(runs):
        if runs[number].first_index != expected and not reasons:
            findings.append(f"episode {number} begins with frame {runs[number].first_index}, not {expected}")
        expected += runs[number].length


def _check_stats(root: Path, info: DatasetInfo, runs: dict[int, Run], findings: list[str]) -> None:
    try:
        stats = read_stats(root)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        findings.append(f"{STATS_PATH} cannot be read: {error}")
        return
    if stats is None:
        if runs:
            findings.append(f"{STATS_PATH} is missing")
        return
    for key, own in stats.items():
        shape = info.features.get(key, {}).get("shape", ())
        if not isinstance(own, dict) or any(value.dtype.kind not in "fiub" for value in own.values()):
            findings.append(f"{STATS_PATH}: the entries of '{key}' are no numbers of shape {tuple(shape)}")


def _n_frames(runs: dict[int, Run]) -> int:
    return sum(run.length for run in runs.values())


def _kept(survey: _Survey) -> list[Kept]:
    kept: list[Kept] = []
    first_index = 0
    for new, old in enumerate(sorted(survey.runs)):
        run = survey.runs[old]
        kept.append(Kept(new, first_index, run, survey.rows.get(old, {})))
        first_index += run.length
    return kept


def finish_repair(root: Path) -> None:
    """Puts a repaired copy in the place of the dataset, if that is all that was left to do when a repair was killed."""
    copy = _copy_of(root)
    if copy.is_dir() and not root.exists():
        os.rename(copy, root)
        flush(root.absolute().parent)


def _copy_of(root: Path) -> Path:
    root = root.absolute()
    return root.with_name(f".{root.name}.repairing")


def _unused(root: Path) -> Path:
    """A name beside the dataset for what it was before."""
    root = root.absolute()
    names = (root.with_name(f"{root.name}.damaged{f'-{number}' if number else ''}") for number in itertools.count())
    return next(name for name in names if not name.exists())


def _flush_all(folder: Path) -> None:
    for path in folder.rglob("*"):
        flush(path)
    flush(folder)


@contextlib.contextmanager
def _lock(root: Path):
    if not root.is_dir():
        yield
        return
    try:
        lock = DatasetLock(root)
    except DatasetLockedError as error:
        raise DatasetDamagedError(str(error)) from None
    try:
        yield
    finally:
        lock.release()
