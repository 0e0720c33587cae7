"""How much memory this process can still use."""

from collections.abc import Iterator
from pathlib import Path

import psutil


def available_memory(processes: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """The bytes that this process can still use: what is free, or less where a container or a job has a limit of its own.

    Args:
        processes: Where Linux says in which groups this process is.
        groups: Where Linux says what these may use.
    """
    free = psutil.virtual_memory().available
    return max(min([free, *_left_in_groups(processes / "self" / "cgroup", groups)]), 0)


def _left_in_groups(own: Path, groups: Path) -> Iterator[int]:
    """What the process's control groups leave, those around them included; files that are only cached do not count."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, name = line.split(":", 2)
        if kinds == "":  # version 2
            yield from _left(groups, name, "memory.max", "memory.current", ("inactive_file", "active_file"))
        elif "memory" in kinds.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file"))
            yield from _left(groups / "memory", name, *names)


def _left(groups: Path, name: str, limit: str, usage: str, cached: tuple[str, ...]) -> Iterator[int]:
    own = Path(name.lstrip("/"))
    for path in (own, *own.parents):  # in a container the outer part of the name leads nowhere
        folder = groups / path
        try:
            most = (folder / limit).read_text().strip()
            used = int((folder / usage).read_text())
            stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        except (OSError, ValueError):
            continue
        if most != "max":
            yield int(most) - used + sum(int(stat.get(entry, 0)) for entry in cached)
