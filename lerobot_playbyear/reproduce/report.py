"""The report: one page that holds everything it shows, and the same in Markdown. A cell that was not run says so.

What is told is gathered here; how it is drawn is in the templates `report.html` and `report.md`.
"""

import base64
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from lerobot_playbyear.datasets import markdown
from lerobot_playbyear.datasets.files import new_file
from lerobot_playbyear.reproduce.plan import Cell, Plan
from lerobot_playbyear.reproduce.table import KEY, N_BEST, Row, Table, best_rate, key_of, mean_and_error, rate

_EXPERT = ("kept", "attempts", "steps", "takeovers", "person_minutes")

Found = Sequence[tuple[Cell, Row | None]]


def write_report(plan: Plan, table: Table) -> list[Path]:
    """Writes the pages of a size into the folder of its runs.

    Returns:
        The page, and the text in Markdown.
    """
    told, paths = gathered(plan, table), []
    for ending in ("html", "md"):
        environment = Environment(
            autoescape=ending == "html", trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined
        )
        environment.filters |= {"shown": _shown, "escaped": markdown.text}
        environment.filters["base64"] = lambda path: base64.b64encode(path.read_bytes()).decode()
        template = files("lerobot_playbyear.reproduce") / f"report.{ending}"
        path = plan.output / plan.size / f"report.{ending}"
        with new_file(path) as partial:
            text = environment.from_string(template.read_text(encoding="utf-8")).render(told)
            partial.write_text(text + "\n", encoding="utf-8")
        paths.append(path)
    return paths


def gathered(plan: Plan, table: Table) -> dict[str, Any]:
    """What the templates show."""
    rows = {key_of(row): row for row in table.rows(plan.size)}
    found = [(cell, rows.get(tuple(getattr(cell, name) for name in KEY))) for cell in plan.cells]
    done = [row for _, row in found if row is not None]
    studies = []
    for name, content in plan.text["studies"].items():
        own = [(cell, row) for cell, row in found if cell.study == name]
        tasks = dict.fromkeys(cell.task for cell, _ in own)
        parts = [_task([each for each in own if each[0].task == task], task, content) for task in tasks]
        studies.append({"title": content["title"], "about": content["about"], "tasks": parts})
    figures = {"n": len(found), "n_done": len(done), "studies": studies, "machines": _machines(done), "done": done}
    return {"size": plan.size, "folder": plan.output / plan.size, **figures}


def _task(found: Found, task: str, study: dict[str, Any]) -> dict[str, Any]:
    own: dict[str, list[Row | None]] = {}
    for cell, row in found:
        own.setdefault(cell.variant, []).append(row)
    done = {variant: [row for row in rows if row is not None] for variant, rows in own.items()}
    best = {variant: [value for value in map(best_rate, rows) if value is not None] for variant, rows in done.items()}
    failures: dict[str, Counter[str]] = {
        name: sum((Counter(row.get("failures", {})) for row in rows), Counter()) for name, rows in done.items()
    }
    films = [(cell.variant, path) for cell, _ in found for path in sorted((cell.folder / "films").glob("*.mp4"))]
    return {
        "name": task,
        "lines": [_line(variant, rows, study) for variant, rows in own.items()],
        "bars": {variant: mean_and_error(values) for variant, values in best.items() if values},
        "curves": {name: curve for name, rows in done.items() if (curve := _curve(rows))},
        "modes": list(dict.fromkeys(mode for count in failures.values() for mode in count)),
        "failures": {variant: count for variant, count in failures.items() if count},
        "expert": [
            (f"{variant}, seed {row['seed']}", [row["expert"].get(name, "") for name in _EXPERT])
            for variant, rows in done.items()
            for row in rows
            if row.get("expert")
        ],
        "films": [(f"{variant}: {path.stem.replace('_', ' ')}", path) for variant, path in films],
    }


def _line(variant: str, rows: Sequence[Row | None], study: dict[str, Any]) -> dict[str, Any]:
    """A row of a task's table; without `success` where nothing was run."""
    done = [row for row in rows if row is not None]
    paper = study.get("paper", {}).get(variant, "")
    line: dict[str, Any] = {"variant": variant, "paper": paper, "seeds": f"{len(done)} of {len(rows)}"}
    line |= {"success": "", "last": [], "early": [], "same": []}
    if not done:
        return line
    if "players" in done[0]:
        players = [(name, each) for row in done for name, each in row.get("players", {}).items()]
        told = [f"{name} ({own['kind']}) {100 * own['successes'] / own['n_episodes']:.0f} %" for name, own in players]
        return {**line, "success": "; ".join(told)}
    curves = [sorted(rate(point["choice"]) for point in row["curve"]) for row in done if row.get("curve")]
    groups: dict[str, str] = {}
    for what, successes in (item for row in done for item in row.get("groups", {}).items()):
        groups[what] = groups.get(what, "") + successes
    apart = [f"{what} {bits.count('1')} of {len(bits)}" for what, bits in groups.items()]
    if first := study.get("first"):  # episodes that are told apart, too
        begun = [row.get("successes", "")[:first].count("1") for row in done]
        apart.append(f"first {first} episodes: {', '.join(map(str, begun))}")
    best = [value for value in map(best_rate, done) if value is not None]
    for name, bits in (("last", "successes"), ("early", "acted_early")):
        line[name] = [rate(row[bits]) for row in done if row.get(bits)]
    same = [statistics.mean(curve[-N_BEST:]) for curve in curves]
    return {**line, "success": "; ".join([_shown(best), *apart]), "same": same}


def _curve(rows: Iterable[Row]) -> dict[int, tuple[float, float | None]]:
    """Success on seeds of choice by kept episodes: mean and standard error over training seeds."""
    points: dict[int, list[float]] = {}
    for point in (point for row in rows for point in row.get("curve", [])):
        points.setdefault(int(point["at"]), []).append(rate(point["choice"]))
    return {at: mean_and_error(points[at]) for at in sorted(points)}


def _machines(done: Iterable[Row]) -> dict[str, Counter[str]]:
    """Of each machine with its versions: its cells and what they took [min]; shared steps are counted for each cell."""
    found: dict[str, Counter[str]] = {}
    for row in done:
        told = [*row.get("machine", {}).values(), *(" ".join(each) for each in row.get("versions", {}).items())]
        where = ", ".join([*map(str, told), f"{row.get('threads', 1)} threads"])
        found.setdefault(where, Counter()).update({"cells": 1, **row.get("minutes", {})})
    return found


def _shown(values: Sequence[float]) -> str:
    """Mean and standard error."""
    if not values:
        return ""
    mean, error = mean_and_error(values)
    return f"{mean:.0f} %" if error is None else f"{mean:.0f} ± {error:.0f} %"
