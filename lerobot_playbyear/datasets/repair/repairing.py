"""Finding out what is wrong with a dataset on disk, and putting it right beside the original.

What interrupted work left is finished before LeRobot, which takes seconds to import, is needed for the survey.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_playbyear.datasets.journal import finish_journal
from lerobot_playbyear.datasets.locking import DatasetLock, DatasetLockedError
from lerobot_playbyear.datasets.repair.replacing import begin_copy, fingerprint, finish_repair, replace
from lerobot_playbyear.datasets.repair.report import DatasetDamagedError, RepairReport

if TYPE_CHECKING:
    from lerobot_playbyear.datasets.repair.plan import Plan
    from lerobot_playbyear.datasets.repair.report import RepairReport


def check_dataset(
    root: str | Path, *, fps: int | None = None, features: dict[str, dict] | None = None, thorough: bool = True
) -> "RepairReport":
    """Looks for damage in a local dataset, changing nothing. Arguments and errors as for `repair_dataset`."""
    return _look(Path(root), fps, features, thorough)[0]


def repair_dataset(
    root: str | Path,
    *,
    fps: int | None = None,
    features: dict[str, dict] | None = None,
    thorough: bool = True,
) -> "RepairReport":
    """Repairs a local dataset of ours or of LeRobot's; every complete episode is kept, bit for bit.

    A recording that was killed has lost its tables' ends, which are made anew from what is there; so are damaged or
    deleted tables in `meta/`. Where frames or pictures are lost, their episodes are dropped and those after them
    move up. The repaired dataset is written beside the damaged one and then takes its place; of a link, the folder
    takes it that the link leads to.

    Only what is proven is damage: bytes that were read, and are wrong both times they are read, and files that a
    folder which can be listed does not have. A file that cannot be read now is an error. Where two things contradict
    each other and nothing proves which is right, that is reported, and nothing is repaired before a person decides it.

    Args:
        root: The dataset's folder.
        fps: Its frames per second, if known; needed only where `meta/info.json` is lost.
        features: Its features, if known; needed only where `meta/info.json` is lost.
        thorough: Read everything, with checksums, and decode all pictures. Otherwise only what tells whether the
            dataset can be opened and continued: this takes seconds, whatever its size.

    Returns:
        What was found and done.

    Raises:
        DatasetDamagedError: It cannot be repaired, or not before something is decided, or no episode would be left.
            Nothing was changed.
        OSError: Something cannot be read now, or the repaired copy cannot be written. Nothing was changed.
        MemoryError: There is no room for something. Nothing was changed.
    """
    root = Path(root)
    finish_repair(root)
    with _lock(root) as lock:
        finish_journal(root)
        report, plan = _look(root, fps, features, thorough)
        if report.is_sound:
            return report
        source = fingerprint(root)
        _confirm(report, _look(root, fps, features, thorough)[0])
        if not report.damage:
            return report
        if report.undecided:
            raise DatasetDamagedError(f"{report}\nNothing was changed.")
        if not report.kept:
            raise DatasetDamagedError(f"{report}\nNo complete episode is left in {root}; nothing was changed.")
        from lerobot_playbyear.datasets.repair.carry_out import write_copy

        copy = begin_copy(root)
        try:
            report.remade += write_copy(root, copy, plan)
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


def _look(root: Path, fps: int | None, features: dict[str, dict] | None, thorough: bool) -> "tuple[RepairReport, Plan]":
    from lerobot_playbyear.datasets.repair.plan import make_plan
    from lerobot_playbyear.datasets.repair.survey import survey

    plan = make_plan(survey(root, fps=fps, features=features, thorough=thorough))
    return plan.survey.report, plan


def _confirm(first: "RepairReport", second: "RepairReport") -> None:
    """Whether a second look at a dataset finds the same.

    Raises:
        OSError: It does not: what is read changes, so that nothing is proven.
    """
    if first != second:
        said = [{*report.damage, *report.undecided, *report.odd} for report in (first, second)]
        raise OSError(
            errno.EIO,
            "what is read changes from one time to the next, so that it may be the disk or the network that fails, and "
            f"not the dataset ({'; '.join(sorted(said[0] ^ said[1])[:3])})",
            str(first.root),
        )


@contextlib.contextmanager
def _lock(root: Path) -> Iterator[DatasetLock | None]:
    try:
        lock = DatasetLock(root) if root.is_dir() else None
    except DatasetLockedError as error:
        raise DatasetDamagedError(str(error)) from None
    try:
        yield lock
    finally:
        if lock is not None:
            lock.release()
