"""The results: a table of JSON lines for each study, a row for each cell."""

import json
import os
import platform
import statistics
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.files import parse_json, write_atomically

Row = dict[str, Any]

KEY = ("study", "task", "variant", "seed", "size")
"""What a row is about; there is one of each."""

N_BEST = 3
"""Checkpoints that were best on the seeds of choice, and are evaluated on held-out ones."""

_KINDS: Row = {
    **dict.fromkeys(("successes", "acted_early"), str),
    **dict.fromkeys(("best", "groups", "versions"), (dict, str)),
    **dict.fromkeys(("minutes", "expert"), (dict, int | float)),
    **{"commands": (list, str), "curve": (list, {"at": int, "choice": str}), "failures": (dict, int), "machine": dict},
    "players": (dict, {"kind": str, "successes": int, "n_episodes": int}),
}
"""What else a row may have: a kind, many of a kind, or parts by name."""


class Table:
    """The tables in a folder; several processes may add rows to them.

    Args:
        folder: Of the tables. It is made when the first row is added.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self, size: str | None = None) -> list[Row]:
        """All rows, or those of a size.

        Raises:
            InputError: A line is damaged.
        """
        found = [row for path in sorted(self.folder.glob("*.jsonl")) for row in _read(path)]
        return [row for row in found if size in (None, row["size"])]

    def get(self, *key: Any) -> Row | None:
        """The row about a study, task, variant, seed and size; None where there is none."""
        return next((row for row in _read(self._path(key[0])) if key_of(row) == key), None)

    def put(self, rows: Iterable[Row]) -> None:
        """Adds rows; those that are there about the same are replaced. Each table is written whole, or stays as it was."""
        self.folder.mkdir(parents=True, exist_ok=True)
        by_study: dict[str, list[Row]] = {}
        for row in rows:
            by_study.setdefault(row["study"], []).append(row)
        for study, own in by_study.items():
            path = self._path(study)
            with FileLock(self.folder / f".{study}.lock"):
                known = {key_of(row): row for row in (*_read(path), *own)}
                lines = [json.dumps(known[key]) + "\n" for key in sorted(known, key=str)]
                write_atomically(path, "".join(lines))

    def merge(self, other: "Table") -> int:
        """Takes in what another folder has and this one lacks. Returns how many rows that were.

        Raises:
            InputError: The other folder holds no tables.
        """
        theirs, known = other.rows(), {key_of(row) for row in self.rows()}
        if not theirs:
            raise InputError(f"{other.folder} holds no rows: give a folder of STUDY.jsonl from playbyear-reproduce.")
        new = [row for row in theirs if key_of(row) not in known]
        self.put(new)
        return len(new)

    def _path(self, study: str) -> Path:
        return self.folder / f"{study}.jsonl"


def key_of(row: Row) -> tuple[Any, ...]:
    return tuple(row[name] for name in KEY)


def _read(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = dict(parse_json(line))
            hash(key_of(row))
            if row["study"] != path.stem:  # a study names the file that its rows are written to
                raise ValueError(f"its study is {row['study']!r}, wanted {path.stem!r}")
            for name, kind in _KINDS.items():
                if name in row and not _is(row[name], kind):
                    raise ValueError(f"its {name} cannot be {row[name]!r}")
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(
                f"{path}:{number} is damaged: {error}. Put it back from a copy, or remove the line."
            ) from error
        rows.append(row)
    return rows


def _is(value: Any, kind: Any) -> bool:
    if isinstance(kind, tuple):
        parts = value.values() if isinstance(value, dict) else value
        return isinstance(value, kind[0]) and all(_is(each, kind[1]) for each in parts)
    if isinstance(kind, dict):
        return isinstance(value, dict) and all(_is(value.get(name), each) for name, each in kind.items())
    return isinstance(value, kind)


# What rows hold


def told(path: Path, first_seed: int, n: int) -> Row:
    """What a file of attempts says of n seeds.

    Returns:
        `successes`, a text with 1 or 0 for each seed in their order; `failures` and `ends`, how often which; `groups`, the
        successes apart for each of the contents, where there are several; `acted_early` (before anything was heard), such a
        text, where the task tells it of every attempt.

    Raises:
        InputError: An attempt is missing.
    """
    lines = [parse_json(line) for line in path.read_text().splitlines()] if path.is_file() else []
    by_seed = {line["seed"]: line for line in lines}
    missing = [seed for seed in range(first_seed, first_seed + n) if seed not in by_seed]
    if missing:
        raise InputError(
            f"{path} lacks the attempt of seed {missing[0]}, and {len(missing) - 1} others. "
            f"Remove {path.parent} and {path.parent}.done.json."
        )
    own = [by_seed[seed] for seed in range(first_seed, first_seed + n)]
    groups: dict[str, str] = {}
    for line in own:
        groups[line.get("contents", "")] = groups.get(line.get("contents", ""), "") + bit(line)
    failed = [line for line in own if not line["is_success"]]
    early = [line.get("acted_early") for line in own]
    return {
        "first_seed": first_seed,
        "successes": "".join(map(bit, own)),
        "failures": dict(Counter(line.get("failure", line["end"]) for line in failed).most_common()),
        "ends": dict(Counter(line["end"] for line in own).most_common()),
        **({"groups": groups} if len(groups) > 1 else {}),
        **({"acted_early": "".join(str(int(each)) for each in early)} if None not in early else {}),
    }


def bit(line: Row) -> str:
    return str(int(line["is_success"]))


def rate(successes: str) -> float:
    """Share of 1 in a text of 0 and 1 [%]."""
    return 100 * successes.count("1") / max(len(successes), 1)


def best_rate(row: Row) -> float | None:
    """Success on held-out seeds, the mean of the checkpoints that were best on those of choice [%]; None of a script."""
    best = row.get("best") or ({"last": row["successes"]} if row.get("successes") else {})
    return statistics.mean(map(rate, best.values())) if best else None


def mean_and_error(values: Sequence[float]) -> tuple[float, float | None]:
    """Their mean, and its standard error; None of one value."""
    error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else None
    return statistics.mean(values), error


def versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("lerobot", "torch", "mujoco")}


def machine() -> dict[str, Any]:
    """The processor, its cores and the card. Asks CUDA, so nothing may be forked after it."""
    torch: Any = sys.modules.get("torch")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    card = {"card": torch.cuda.get_device_name()} if torch and torch.cuda.is_available() else {}
    return {"processor": _processor(), "cores": cores, **card}


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())
