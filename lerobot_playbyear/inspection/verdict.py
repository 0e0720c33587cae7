"""What a check says: one line for a person, figures for a program."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Level = Literal["ok", "info", "warning", "error"]

LEVELS: tuple[Level, ...] = ("ok", "info", "warning", "error")
"""From what needs no attention to what makes the dataset unfit."""

_LISTED = 8  # episodes named in a line before it is cut


@dataclass(frozen=True)
class Verdict:
    """The result of one check.

    Args:
        check: What was checked, a few words.
        level: "ok", "info" (told, not judged), "warning" (worth a look) or "error" (training on it would go wrong).
        message: One sentence with the figures that the level rests on.
        feature: The key it is about, where it is about one.
        episodes: The episodes it is about; empty where it is about the whole dataset.
        figures: What was measured, by name.
    """

    check: str
    level: Level
    message: str
    feature: str | None = None
    episodes: Sequence[int] = ()
    figures: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "episodes": [int(episode) for episode in self.episodes]}


def worst(verdicts: Iterable[Verdict]) -> Level:
    """The most severe level among them; "ok" without any."""
    return max((verdict.level for verdict in verdicts), key=LEVELS.index, default="ok")


def name_episodes(episodes: Sequence[int]) -> str:
    """ "episode 3" or "episodes 1, 4, 7 and 12 more"."""
    shown = ", ".join(str(episode) for episode in episodes[:_LISTED])
    more = f" and {len(episodes) - _LISTED} more" if len(episodes) > _LISTED else ""
    return f"episode{'s' if len(episodes) > 1 else ''} {shown}{more}"
