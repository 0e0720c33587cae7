"""Verdicts for a person at a terminal, and for a program."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_playbyear.inspection.source import DatasetSource
from lerobot_playbyear.inspection.verdict import LEVELS, Verdict, worst

_COLOURS = {"ok": "32", "info": "36", "warning": "33", "error": "31;1"}


def dataset_facts(source: DatasetSource) -> dict[str, Any]:
    """What the dataset is, for the head of a report."""
    return {
        "repo_id": source.dataset.repo_id,
        "root": str(source.dataset.root),
        "robot_type": source.dataset.meta.robot_type,
        "fps": source.fps,
        "episodes": len(source.episodes),
        "frames": len(source),
        "seconds": len(source) / source.fps,
        "cameras": {key: list(source.features[key]["shape"]) for key in source.cameras},
        "microphones": {key: (source.features[key].get("info") or {}).get("sample_rate") for key in source.microphones},
        "tasks": sorted({source.task(episode) for episode in source.episodes}),
    }


def as_text(source: DatasetSource, verdicts: Sequence[Verdict], colour: bool = False) -> str:
    """One line per verdict, between a head and a summary."""
    facts = dataset_facts(source)
    name_width = max(len(verdict.check) for verdict in verdicts)
    lines = [
        _printable(f"{facts['repo_id']} in {facts['root']}"),
        f"{facts['episodes']} episodes, {facts['frames']:,} frames, {facts['seconds']:,.1f} s at {facts['fps']} Hz; "
        f"cameras: {_printable(_names(source.cameras))}; microphones: {_printable(_names(source.microphones))}",
        "",
    ]
    for verdict in verdicts:
        level = f"\033[{_COLOURS[verdict.level]}m{verdict.level:<7}\033[0m" if colour else f"{verdict.level:<7}"
        feature = f"{verdict.feature}: " if verdict.feature else ""
        lines.append(f"{level}  {verdict.check:<{name_width}}  {_printable(feature + verdict.message)}")
    return "\n".join([*lines, "", summary(verdicts)])


def as_json(source: DatasetSource, verdicts: Sequence[Verdict]) -> str:
    """The same for a program."""
    report = {
        "dataset": dataset_facts(source),
        "worst": worst(verdicts),
        "verdicts": [verdict.to_dict() for verdict in verdicts],
    }
    return json.dumps(finite(report), indent=2, allow_nan=False)


def finite(value: Any) -> Any:
    """The same for JSON, which has no NaN and no infinite numbers, though Python reads them in one: null for each."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    return [finite(each) for each in value] if isinstance(value, list | tuple) else value


def summary(verdicts: Sequence[Verdict]) -> str:
    """ "19 checks: 17 ok, 1 info, 1 warning"."""
    counts = Counter(verdict.level for verdict in verdicts)
    parts = [f"{counts[level]} {level}{_plural(level, counts[level])}" for level in LEVELS if counts[level]]
    return f"{len(verdicts)} checks: {', '.join(parts)}"


def _plural(level: str, count: int) -> str:
    return "s" if count != 1 and level in ("warning", "error") else ""


def _names(keys: Sequence[str]) -> str:
    return ", ".join(key.split(".", 2)[-1] for key in keys) or "none"


def _printable(text: str) -> str:
    """Without the characters that command a terminal; names and messages may be a stranger's."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
