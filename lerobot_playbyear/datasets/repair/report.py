"""What is said about a dataset that was checked or repaired.

That something cannot be read now is nothing to report but an OSError, which ends the survey: nothing can be planned on it.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

_MOST_MOVES = 20  # that are named


class DatasetDamagedError(ValueError):
    """A dataset cannot be repaired; nothing was changed."""


@dataclass
class RepairReport:
    """What was wrong with a dataset, and what became of it. Whoever looks at a part of the dataset adds what is wrong there.

    Args:
        root: Its folder.
        findings: What was proven to be wrong, a line each; empty for a sound dataset. It was read, and is wrong, or a
            folder that can be listed does not have it; what proves it also says what is right, or that it is lost.
        kept: Where each complete episode is now: its number before, and now.
        dropped: The episodes that are not complete: their number before, and why.
        undecided: Where two things contradict each other, nothing proves which is right, and what a person can do about it;
            before that nothing is repaired.
        odd: The same, where no repair depends on it: it stays as it is.
        remade: What of the rest was made anew, is other than it was, or stays behind in `original`, a line each.
        original: Where the damaged dataset was put; None where nothing was changed.
    """

    root: Path
    findings: list[str] = field(default_factory=list)
    kept: dict[int, int] = field(default_factory=dict)
    dropped: dict[int, str] = field(default_factory=dict)
    undecided: list[str] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)
    remade: list[str] = field(default_factory=list)
    original: Path | None = None

    @property
    def damage(self) -> list[str]:
        """What is proven to be wrong, and which episodes are lost to it, a line each."""
        lost = [f"episode {number} is lost: {reason}" for number, reason in sorted(self.dropped.items())]
        return [*self.findings, *lost]

    @property
    def is_sound(self) -> bool:
        """Whether nothing is wrong; what is odd does not count."""
        return not self.damage and not self.undecided

    @property
    def changed(self) -> bool:
        """Whether the dataset was repaired."""
        return self.original is not None

    def __str__(self) -> str:
        lines = [self._verdict(), *_items(self.damage)]
        if self.undecided:
            lines += [
                "What looks wrong, and nothing proves; nothing is repaired before you decide it:",
                *_items(self.undecided),
            ]
        if not self.is_sound:
            lines.append(f"{'Kept' if self.changed else 'Can be kept'}: {len(self.kept)} complete episodes.")
        moved = {old: new for old, new in self.kept.items() if old != new}
        if moved:
            pairs = ", ".join(f"{old} is now {new}" for old, new in sorted(moved.items())[:_MOST_MOVES])
            lines.append(f"Numbered anew: {pairs}{' ...' if len(moved) > _MOST_MOVES else ''}.")
        lines += _items(self.remade)
        if self.odd:
            lines += ["What looks odd, and stays as it is:", *_items(self.odd)]
        if self.changed:
            lines.append(f"The damaged dataset is untouched in {self.original}; delete it when you no longer need it.")
        return "\n".join(lines)

    def _verdict(self) -> str:
        if self.is_sound:
            return f"{self.root}: {len(self.kept)} episodes, nothing wrong."
        if not self.damage:
            return f"{self.root} contradicts itself."
        return f"{self.root} was damaged:" if self.changed else f"{self.root} is damaged:"


def name_episodes(numbers: Iterable[int]) -> str:
    """`episode 3`, or `episodes 3, 5 to 9 and 12`."""
    ordered = sorted(numbers)
    parts: list[str] = []
    for _, group in itertools.groupby(enumerate(ordered), key=lambda pair: pair[1] - pair[0]):
        span = [number for _, number in group]
        parts.append(str(span[0]) if len(span) == 1 else f"{span[0]} to {span[-1]}")
    listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"episode{'s' if len(ordered) > 1 else ''} {listed}"


def _items(lines: list[str]) -> list[str]:
    return [f"  - {line}" for line in lines]
