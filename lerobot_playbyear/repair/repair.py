"""`playbyear-repair`: says what is wrong with a dataset, and writes a copy with every episode that is whole.

The dataset itself is not changed. So nothing has to be proven before it may be dropped: what is not in the copy is still
there. LeRobot is imported when there is a dataset.
"""

import shlex
from dataclasses import dataclass
from pathlib import Path

from lerobot_playbyear.datasets.errors import InputError, printable
from lerobot_playbyear.datasets.files import INFO_PATH, check_can_be_made, is_listed, new_folder
from lerobot_playbyear.datasets.findings import Finding
from lerobot_playbyear.datasets.info import check_links, check_parts, check_there
from lerobot_playbyear.datasets.journal import JOURNAL, finish_journal, locked
from lerobot_playbyear.datasets.remedies import repair_command
from lerobot_playbyear.datasets.survey import DatasetDamagedError, Survey, survey
from lerobot_playbyear.repair.footers import rescue

_MOST_MOVES = 20  # that are named


@dataclass
class RepairConfig:
    """Options of `playbyear-repair`.

    Args:
        root: Folder of the dataset.
        output: Folder of the copy. None: the dataset's with `_repaired` appended.
        like: Folder of a dataset recorded with the same settings, whose frame rate and features are used. Needed only if
            `meta/info.json` is lost.
        dry_run: Report the damage without writing a copy.
    """

    root: Path
    output: Path | None = None
    like: Path | None = None
    dry_run: bool = False


@dataclass(frozen=True)
class RepairReport:
    """What was wrong with a dataset, and what became of it.

    Args:
        survey: What was found.
        target: The repaired copy; None where none was written.
    """

    survey: Survey
    target: Path | None = None

    @property
    def kept(self) -> dict[int, int]:
        """The number of every whole episode, and its number in the copy."""
        return {episode.number: number for number, episode in enumerate(self.survey.whole)}

    @property
    def left(self) -> list[Finding]:
        """What only a person can put right."""
        return [finding for finding in self.survey.findings if finding.level == "error" and finding.remedy]

    @property
    def is_done(self) -> bool:
        """Whether there is a dataset now with which nothing is wrong."""
        return self.survey.is_undamaged or (self.target is not None and not self.left)

    def __str__(self) -> str:
        lines = [str(self.survey)]
        if self.target is None:
            return lines[0]
        moved = [f"{old} is now {new}" for old, new in self.kept.items() if old != new]
        if moved:
            more = " ..." if len(moved) > _MOST_MOVES else ""
            lines.append(f"Renumbered: {', '.join(moved[:_MOST_MOVES])}{more}.")
        root = self.survey.root
        lines.append(f"A copy with {len(self.kept)} whole episodes is in {self.target}; {root} is as it was.")
        if self.left:
            lines.append(f"What is left to be done in the copy: {'. '.join(each.remedy for each in self.left)}.")
        old, aside, new = (shlex.quote(str(each)) for each in (root, f"{root}_damaged", self.target))
        lines.append(f"To put it in the dataset's place: mv {old} {aside} && mv {new} {old}")
        return "\n".join(lines)


def repair(cfg: RepairConfig) -> RepairReport:
    """Looks, and unless it is a dry run writes the copy. Prints what was found.

    Raises:
        ValueError: It cannot be repaired, or it or `like` is no dataset, or the copy cannot be made.
        OSError: `like` or the dataset cannot be read now, or the copy cannot be written.
        MemoryError: There is not enough of it.
    """
    report = look(cfg.root, cfg.like) if cfg.dry_run else repair_dataset(cfg.root, cfg.output, cfg.like)
    print(printable(report))
    return report


def look(root: Path, like: Path | None = None) -> RepairReport:
    """What a repair would keep. Arguments and errors as for `repair_dataset`."""
    if like is not None and not (like / INFO_PATH).is_file():
        raise InputError(f"--like={like} holds no LeRobotDataset: no {INFO_PATH}. Give one with the same settings.")
    if root.is_dir() and is_listed(root, JOURNAL):
        raise InputError(
            f"An episode in {root / JOURNAL.parent} is complete, and still has to be moved into its place: it would be called "
            f"lost. Make the folder writable, or work on a copy that is, and run `{repair_command(root)}`."
        )
    report = RepairReport(survey(root, rescue=rescue, like=like))
    if report.survey.damage and not report.kept and like is None:
        check_parts(root, can_be_repaired=True)
    return report


def repair_dataset(root: str | Path, target: str | Path | None = None, like: Path | None = None) -> RepairReport:
    """Writes a copy of a local dataset of ours or of LeRobot's with every whole episode, bit for bit.

    A recording that was killed has lost its tables' ends, which are made again from what is there; so are damaged or
    deleted tables in `meta/`. Episodes of which frames or pictures are lost are not in the copy, and those after them move
    up. What a writer of ours had begun to move into the dataset is finished first; else nothing in the dataset is changed.

    Args:
        root: The dataset's folder.
        target: The copy's folder, which is there only when it is complete; None: beside the dataset, `<root>_repaired`.
        like: See `RepairConfig`.

    Returns:
        What was found, and where the copy is; without damage that a copy can put right, there is none.

    Raises:
        DatasetDamagedError: No episode in it is whole.
        OutsideError: A link leads out of its folder: the copy would hold what it leads to.
        InputError: It is no dataset, or the copy's folder is there already, or cannot be made; or an episode still has to be
            moved into place, and nothing can be written there.
        OSError: Something cannot be read now, or the copy cannot be written.
        MemoryError: There is no room for something.
    """
    root = Path(root)
    if not (root / JOURNAL).exists():
        check_there(root)  # before anything is written there, if only a lock
    named = root if root.name else root.absolute()
    target = Path(target) if target is not None else named.with_name(f"{named.name}_repaired")
    with locked(root) as is_locked:
        if is_locked:
            finish_journal(root)
        report = look(root, like)
        if not report.survey.damage:
            return report
        if not report.kept:
            raise DatasetDamagedError(f"{report}\nNo whole episode is left in {root}; no copy was written.")
        if target.exists():
            raise InputError(f"--output={target} is there already. Give another, or delete it.")
        check_can_be_made(target, f"--output={target}")
        check_links(root)
        from lerobot_playbyear.repair.copy import write_copy

        with new_folder(target) as folder:
            write_copy(report.survey, folder)
            again = survey(folder, thorough=False)
            if again.damage:
                raise DatasetDamagedError(f"The copy of {root} is not sound, and was not kept. {again}")
    return RepairReport(report.survey, target)
