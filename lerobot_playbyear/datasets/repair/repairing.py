"""Finding out what is wrong with a dataset on disk, and putting it right beside the original."""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from lerobot.datasets.utils import STATS_PATH, DatasetInfo

from lerobot_playbyear.datasets.journal import finish_journal
from lerobot_playbyear.datasets.locking import DatasetLock, DatasetLockedError
from lerobot_playbyear.datasets.repair.copying import Kept, write_copy
from lerobot_playbyear.datasets.repair.episodes import Row, choose_runs, plausible, read_rows, trusted_rows
from lerobot_playbyear.datasets.repair.features import settle_features
from lerobot_playbyear.datasets.repair.frames import Run, read_frames
from lerobot_playbyear.datasets.repair.info import DatasetDamagedError, correct_rates, read_info
from lerobot_playbyear.datasets.repair.metadata import read_own_stats
from lerobot_playbyear.datasets.repair.replacing import begin_copy, fingerprint, finish_repair, replace
from lerobot_playbyear.datasets.repair.tasks import read_tasks
from lerobot_playbyear.datasets.repair.videos import check_videos

__all__ = ["RepairReport", "check_dataset", "finish_repair", "repair_dataset"]

_MOST_EPISODES = 10_000  # that are believed to be lost; a larger number was misread


@dataclass
class RepairReport:
    """What was wrong with a dataset, and what became of it.

    Args:
        root: Its folder.
        findings: What was wrong, a line each; empty for a sound dataset.
        kept: Where each complete episode is now: its number before, and now.
        dropped: The episodes that are not complete: their number before, and why.
        remade: What of the rest was made anew, is other than it was, or stays behind in `original`, a line each.
        original: Where the damaged dataset was put; None where nothing was changed.
    """

    root: Path
    findings: list[str] = field(default_factory=list)
    kept: dict[int, int] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)
    remade: list[str] = field(default_factory=list)
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
        lines += [f"  - {what}" for what in self.remade]
        if self.changed:
            lines.append(f"The damaged dataset is untouched in {self.original}; delete it when you no longer need it.")
        return "\n".join(lines)


@dataclass
class _Survey:
    info: DatasetInfo
    tasks: pd.DataFrame
    runs: dict[int, Run]
    rows: dict[int, Row]
    rows_before: dict[int, Row]
    tables_are_whole: bool
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
) -> RepairReport:
    """Repairs a local dataset of ours or of LeRobot's; every complete episode is kept, bit for bit.

    A recording that was killed has lost its tables' ends, which are made anew from what is there; so are damaged or
    deleted tables in `meta/`. Where frames or pictures are lost, their episodes are dropped and those after them
    move up. The repaired dataset is written beside the damaged one and then takes its place; of a link, the folder
    takes it that the link leads to.

    Only what is proven is damage: bytes that were read, and are wrong both times they are read, and files that a
    folder which can be listed does not have. A file that cannot be read now is an error.

    Args:
        root: The dataset's folder.
        fps: Its frames per second, if known; needed only where `meta/info.json` is lost.
        features: Its features, if known; needed only where `meta/info.json` is lost.
        thorough: Read everything, with checksums, and decode all pictures. Otherwise only what tells whether the
            dataset can be opened and continued: this takes seconds, whatever its size.

    Returns:
        What was found and done.

    Raises:
        DatasetDamagedError: It cannot be repaired, or no episode would be left. Nothing was changed.
        OSError: Something cannot be read now, or the repaired copy cannot be written. Nothing was changed.
        MemoryError: There is no room for something. Nothing was changed.
    """
    root = Path(root)
    finish_repair(root)
    with _lock(root) as lock:
        finish_journal(root)
        survey = _survey(root, fps, features, thorough)
        report = survey.report
        if report.is_sound:
            return report
        source = fingerprint(root)
        _confirm(report, _survey(root, fps, features, thorough).report)
        if not report.kept:
            raise DatasetDamagedError(f"{report}\nNo complete episode is left in {root}; nothing was changed.")
        copy = begin_copy(root)
        try:
            report.remade += write_copy(
                root,
                copy,
                survey.info,
                survey.tasks,
                _kept(survey),
                list(survey.rows_before.values()),
                tables_stay=survey.tables_are_whole and not report.dropped,
            )
            again = check_dataset(copy, thorough=False)
            if not again.is_sound:
                raise DatasetDamagedError(f"The repaired copy of {root} is not sound; nothing was changed. {again}")
            report.original = replace(root, copy, source)
        except BaseException:
            if os.path.lexists(root.resolve()):  # otherwise it was stopped in the last step, which can be finished
                shutil.rmtree(copy, ignore_errors=True)
            raise
        if lock is not None:
            lock.moved_to(report.original)
    return report


def _confirm(first: RepairReport, second: RepairReport) -> None:
    """Whether a second look at a dataset finds the same damage.

    Raises:
        OSError: It does not: what is read changes, so that nothing is proven.
    """
    if (first.findings, first.kept, first.dropped) != (second.findings, second.kept, second.dropped):
        lines = {*first.findings, *first.dropped.values()} ^ {*second.findings, *second.dropped.values()}
        raise OSError(
            errno.EIO,
            "what is read changes from one time to the next, so that it may be the disk or the network that fails, and "
            f"not the dataset ({'; '.join(sorted(lines)[:3])})",
            str(first.root),
        )


def _survey(root: Path, fps: int | None, features: dict[str, dict] | None, thorough: bool) -> _Survey:
    findings: list[str] = []
    reasons: dict[int, str] = {}
    if not root.is_dir():
        raise DatasetDamagedError(f"{root} holds no LeRobotDataset: it is no folder.")
    info = read_info(root, fps, features, findings)
    settle_features(root, info, features, findings)
    frames = read_frames(root, info, thorough, findings)
    correct_rates(info, frames.frame_seconds, findings)
    n_before = len(findings)
    rows = read_rows(root, findings)
    rows, found = plausible(rows, frames.runs, findings)
    tables_are_whole = len(findings) == n_before
    rows_before = rows
    runs = choose_runs(found, rows, reasons)
    tasks = read_tasks(root, rows, runs, findings)
    rows = trusted_rows(rows, runs, info, findings)
    check_videos(root, info, runs, rows, thorough, reasons, findings)
    _check_counts(info, runs, reasons, findings)
    _check_stats(root, info, runs, findings)
    report = RepairReport(root, findings, {old: new for new, old in enumerate(sorted(runs))}, reasons)
    return _Survey(info, tasks, runs, rows, rows_before, tables_are_whole, report)


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
    stats, problems = read_own_stats(root, info.features)
    if stats is not None or runs or problems != ["is missing"]:
        findings.extend(f"{STATS_PATH}{':' if stats is not None else ''} {problem}" for problem in problems)


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


@contextlib.contextmanager
def _lock(root: Path) -> Iterator[DatasetLock | None]:
    if not root.is_dir():
        yield None
        return
    try:
        lock = DatasetLock(root)
    except DatasetLockedError as error:
        raise DatasetDamagedError(str(error)) from None
    try:
        yield lock
    finally:
        lock.release()
