"""What can be found wrong with a dataset: a state for each thing, and a sentence that says it.

That something cannot be read now is no state but an OSError, which ends the survey: nothing can be planned on it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto


class DatasetDamagedError(ValueError):
    """A dataset cannot be repaired; nothing was changed."""


class State(Enum):
    """How a thing was found."""

    FINE = auto()
    DAMAGED = auto()
    """It was read, and is wrong; what proves it also says what is right, or that it is lost."""
    MISSING = auto()
    """A folder that can be listed does not have it, or a table that can be read does not name it."""
    UNDECIDED = auto()
    """Two things contradict each other, and nothing proves which is right: a person decides, before any repair."""
    ODD = auto()
    """The same, where no repair depends on it: it stays as it is."""


class Thing(Enum):
    """What a finding is about."""

    INFO = auto()  # an entry of meta/info.json
    FEATURE = auto()
    FILE = auto()  # with frames
    TABLE = auto()  # of episodes
    ROW = auto()  # of such a table
    EPISODE = auto()
    TASKS = auto()
    STATISTICS = auto()
    VIDEO = auto()


@dataclass(frozen=True)
class Finding:
    """Something that is not fine.

    Args:
        thing: What it is about.
        state: How it was found.
        said: A sentence with its name; of what is undecided or odd, also what a person can do.
    """

    thing: Thing
    state: State
    said: str


def name_episodes(numbers: Iterable[int]) -> str:
    """`episode 3`, or `episodes 3, 5 to 9 and 12`."""
    spans: list[list[int]] = []
    for number in sorted(numbers):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    parts = [str(first) if first == last else f"{first} to {last}" for first, last in spans]
    listed = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
    return f"episode{'s' if len(spans) > 1 or spans[0][0] != spans[0][1] else ''} {listed}"
