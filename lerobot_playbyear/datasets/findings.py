"""What checks of a dataset say: one line for a person, figures for a program."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Level = Literal["ok", "info", "warning", "error"]

LEVELS: tuple[Level, ...] = ("ok", "info", "warning", "error")
"""From what needs no attention to what makes the dataset unfit."""

_MOST_NAMED = 8  # episodes in a line before it is cut


@dataclass(frozen=True)
class Finding:
    """The result of one check: one line for a person, figures for a program.

    Args:
        check: What was checked, a few words.
        level: "ok", "info" (told, not judged), "warning" (worth a look) or "error" (training on it would go wrong).
        message: One sentence with the figures that the level rests on.
        feature: The key it is about, where it is about one.
        episodes: The episodes it is about; empty where it is about the whole dataset.
        figures: What was measured, by name.
        remedy: What a person has to do about it. Of a survey's finding without one: `playbyear-repair` makes it good.
    """

    check: str
    level: Level
    message: str
    feature: str | None = None
    episodes: Sequence[int] = ()
    figures: dict[str, Any] = field(default_factory=dict)
    remedy: str = ""

    def __str__(self) -> str:
        return ". ".join(part for part in (self.message, self.remedy) if part)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the message ends with the remedy."""
        fields = {**asdict(self), "message": str(self), "episodes": [int(episode) for episode in self.episodes]}
        del fields["remedy"]
        return fields


def worst(findings: Iterable[Finding]) -> Level:
    """The most severe level among them; "ok" without any."""
    return max((finding.level for finding in findings), key=LEVELS.index, default="ok")


def summary(findings: Sequence[Finding]) -> str:
    """ "19 checks: 17 ok, 1 info, 1 warning"."""
    counts = Counter(finding.level for finding in findings)
    plural = {level: "s" if level in ("warning", "error") and counts[level] > 1 else "" for level in LEVELS}
    parts = [f"{counts[level]} {level}{plural[level]}" for level in LEVELS if counts[level]]
    return f"{len(findings)} checks: {', '.join(parts)}"


def name_episodes(episodes: Sequence[int]) -> str:
    """`episode 3`, or `episodes 1, 4, 7 and 12 more`."""
    shown = ", ".join(str(episode) for episode in episodes[:_MOST_NAMED])
    more = f" and {len(episodes) - _MOST_NAMED} more" if len(episodes) > _MOST_NAMED else ""
    return f"episode{'s' if len(episodes) > 1 else ''} {shown}{more}"
