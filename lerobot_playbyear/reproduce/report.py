"""The report: one page that holds everything it shows, and the same in Markdown. A cell that was not run says so."""

import base64
import html
import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot_playbyear.datasets.files import new_file
from lerobot_playbyear.reproduce.plan import Cell, Plan
from lerobot_playbyear.reproduce.table import Row, Table, best_rate, key_of, mean_and_error, rate

NOT_RUN = "not run"
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b2579a", "#c28600", "#4aa3d6", "#5b6875", "#17212b")
_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 640, 260, 44, 34  # of a figure [px]
_STYLE = """body{font:14px/1.5 system-ui,sans-serif;max-width:980px;margin:2em auto;padding:0 1em;color:#17212b}
table{border-collapse:collapse;margin:1em 0}td,th{border-bottom:1px solid #dde2e8;padding:3px 10px;text-align:left}
pre{overflow-x:auto;background:#f4f5f7;padding:8px}figure{display:inline-block;margin:8px}video{width:220px}
svg{max-width:100%}.k{color:#5b6875}"""


@dataclass(frozen=True)
class Block:
    """A part of the report: a heading, a text, a table (head, rows), a figure, a film, or commands."""

    kind: str
    text: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    path: Path | None = None


def write_report(plan: Plan, table: Table) -> list[Path]:
    """Writes the pages of a size into the folder of its runs.

    Returns:
        The page, and the text in Markdown.
    """
    blocks = list(_blocks(plan, table))
    pages = {"html": _as_html(blocks), "md": _as_markdown(blocks, plan.output / plan.size)}
    paths = []
    for ending, text in pages.items():
        path = plan.output / plan.size / f"report.{ending}"
        with new_file(path) as partial:
            partial.write_text(text, encoding="utf-8")
        paths.append(path)
    return paths


# What is told


def _blocks(plan: Plan, table: Table) -> Iterable[Block]:
    rows = {key_of(row): row for row in table.rows(plan.size)}
    found = [(cell, rows.get((cell.study, cell.task, cell.variant, cell.seed, cell.size))) for cell in plan.cells]
    n_done = sum(row is not None for _, row in found)
    yield Block("heading", f"Play it by Ear, again: size {plan.size}")
    yield Block(
        "text",
        f"{n_done} of {len(found)} cells are done. The best three checkpoints are chosen on seeds of choice and scored on "
        "held-out ones: mean and standard error over training seeds. The paper's way chooses and scores on the same.",
    )
    for study, content in plan.text["studies"].items():
        own = [(cell, row) for cell, row in found if cell.study == study]
        if own:
            yield Block("section", content["title"])
            yield Block("text", content["about"])
            yield from _study(own, content.get("paper", {}))
    done = [row for _, row in found if row is not None]
    yield from _how(done)


def _study(found: Sequence[tuple[Cell, Row | None]], paper: dict[str, str]) -> Iterable[Block]:
    tasks = dict.fromkeys(cell.task for cell, _ in found)
    for task in tasks:
        own: dict[str, list[Row | None]] = {}
        for cell, row in found:
            if cell.task == task:
                own.setdefault(cell.variant, []).append(row)
        head = (task, "success", "last checkpoint", "the paper's way", "training seeds", "paper")
        yield Block(
            "table", head=head, rows=[_line(variant, rows, paper.get(variant, "")) for variant, rows in own.items()]
        )
        done = {variant: [row for row in rows if row is not None] for variant, rows in own.items()}
        bars = {variant: _figures(map(best_rate, rows)) for variant, rows in done.items()}
        if any(bars.values()):
            yield Block("figure", _bars({variant: values for variant, values in bars.items() if values}))
        curves = {variant: _curve(rows) for variant, rows in done.items() if any(row.get("curve") for row in rows)}
        if curves:
            yield Block("figure", _curves(curves))
            points = sorted({at for curve in curves.values() for at in curve})
            shown = [(name, *(_shown(curve.get(at, [])) for at in points)) for name, curve in curves.items()]
            yield Block("curve", head=("kept episodes", *map(str, points)), rows=shown)
        yield from _failures(done)
        for cell, _ in found:
            if cell.task == task:
                for film in sorted((cell.folder / "films").glob("*.mp4")):
                    yield Block("film", f"{cell.variant}: {film.stem.replace('_', ' ')}", path=film)


def _line(variant: str, rows: Sequence[Row | None], paper: str) -> tuple[str, ...]:
    done = [row for row in rows if row is not None]
    if not done:
        return variant, NOT_RUN, "", "", f"0 of {len(rows)}", paper
    if "players" in done[0]:
        told = [
            f"{name} ({each['kind']}) {100 * each['successes'] / each['n_episodes']:.0f} %"
            for row in done
            for name, each in row["players"].items()
        ]
        return variant, "; ".join(told), "", "", "", paper
    same = [[rate(point["choice"]) for point in row["curve"]] for row in done if row.get("curve")]
    on_choice = [sum(sorted(rates)[-3:]) / len(rates[-3:]) for rates in same]
    groups = Counter[str]()
    for what, successes in itertools.chain.from_iterable(row.get("groups", {}).items() for row in done):
        groups.update({what: successes.count("1"), f"{what} of": len(successes)})
    apart = "".join(f"; {what} {groups[what]} of {groups[f'{what} of']}" for what in groups if not what.endswith(" of"))
    last = _shown([rate(row["successes"]) for row in done])
    n = f"{len(done)} of {len(rows)}, {len(done[0]['successes'])} episodes each"
    return variant, _shown(_figures(map(best_rate, done))) + apart, last, _shown(on_choice), n, paper


def _failures(done: dict[str, list[Row]]) -> Iterable[Block]:
    """How often which way to fail, and what the expert spent."""
    counts = {
        variant: sum((Counter(row.get("failures", {})) for row in rows), Counter()) for variant, rows in done.items()
    }
    modes = list(dict.fromkeys(mode for count in counts.values() for mode, _ in count.most_common()))
    if modes:
        rows = [(variant, *(str(count[mode]) for mode in modes)) for variant, count in counts.items() if count]
        yield Block("table", head=("failures of the last checkpoint", *modes), rows=rows)
    spent = [
        (variant, row["seed"], row["expert"]) for variant, rows in done.items() for row in rows if row.get("expert")
    ]
    if spent:
        names = ("kept", "attempts", "steps", "takeovers", "person_minutes")
        lines = [(f"{variant}, seed {seed}", *(str(cost[name]) for name in names)) for variant, seed, cost in spent]
        yield Block("table", head=("the expert", *(name.replace("_", " ") for name in names)), rows=lines)


def _how(done: Sequence[Row]) -> Iterable[Block]:
    yield Block("section", "Commands, versions and machines")
    if not done:
        yield Block("text", f"Nothing was {NOT_RUN.removeprefix('not ')} yet.")
        return
    machines: dict[str, Counter[str]] = {}
    for row in done:
        told = [
            *row.get("machine", {}).values(),
            *(f"{name} {number}" for name, number in row.get("versions", {}).items()),
        ]
        where = ", ".join(map(str, told)) + f", {row.get('threads', 1)} threads"
        machines.setdefault(where, Counter()).update({"cells": 1, **row.get("minutes", {})})
    for where, spent in machines.items():
        parts = ", ".join(f"{name} {minutes:.0f}" for name, minutes in spent.items() if name != "cells")
        yield Block("text", f"{spent['cells']} cells on {where}. Minutes, shared steps counted for each: {parts}.")
    for row in done:
        name = "/".join(str(row[key]) for key in ("study", "task", "variant")) + f"/seed={row['seed']}"
        yield Block("code", "\n".join(row.get("commands", [])), head=(name,))


def _figures(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _curve(rows: Sequence[Row]) -> dict[int, list[float]]:
    """Success on seeds of choice by kept episodes, of each training seed."""
    found: dict[int, list[float]] = {}
    for row in rows:
        for point in row.get("curve", []):
            found.setdefault(int(point["at"]), []).append(rate(point["choice"]))
    return found


def _shown(values: Sequence[float]) -> str:
    if not values:
        return ""
    mean, error = mean_and_error(values)
    return f"{mean:.0f} %" if error is None else f"{mean:.0f} ± {error:.0f} %"


# How it is drawn


def _frame(inside: str, legend: Iterable[str], labels: Iterable[tuple[float, str]]) -> str:
    names = [
        f'<text x="{_WIDTH + 12}" y="{16 + 16 * i}" fill="{_colour(i)}">{html.escape(n)}</text>'
        for i, n in enumerate(legend)
    ]
    grid = [
        f'<path d="M{_LEFT} {_y(v):.0f}H{_WIDTH}" stroke="#dde2e8"/><text x="4" y="{_y(v) + 4:.0f}">{v} %</text>'
        for v in range(0, 101, 25)
    ]
    below = [
        f'<text x="{x:.0f}" y="{_HEIGHT - 12}" text-anchor="middle">{html.escape(text)}</text>' for x, text in labels
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH + 240} {_HEIGHT}" width="{_WIDTH + 240}" '
        f'font-size="12" font-family="sans-serif">{"".join(grid)}{inside}{"".join(below)}{"".join(names)}</svg>'
    )


def _bars(values: dict[str, list[float]]) -> str:
    """A bar for each, with its standard error."""
    step, parts = (_WIDTH - _LEFT) / len(values), []
    for i, rates in enumerate(values.values()):
        mean, error = mean_and_error(rates)
        x, middle, spread = _LEFT + step * (i + 0.15), _LEFT + step * (i + 0.5), error or 0.0
        height = _y(0) - _y(mean)
        parts.append(
            f'<rect x="{x:.0f}" y="{_y(mean):.1f}" width="{0.7 * step:.0f}" height="{height:.1f}" fill="{_colour(i)}"/>'
        )
        parts.append(f'<path d="M{middle:.0f} {_y(mean - spread):.1f}V{_y(mean + spread):.1f}" stroke="#17212b"/>')
    return _frame("".join(parts), values, [])


def _curves(curves: dict[str, dict[int, list[float]]]) -> str:
    """A line for each, with a band of a standard error to either side."""
    last, parts = max(at for curve in curves.values() for at in curve), []
    points = sorted({at for curve in curves.values() for at in curve})

    def x(at: int) -> float:
        return _LEFT + (_WIDTH - _LEFT) * at / max(last, 1)

    for i, curve in enumerate(curves.values()):
        told = [(x(at), *mean_and_error(curve[at])) for at in sorted(curve)]
        upper = [f"{px:.0f},{_y(mean + (error or 0)):.1f}" for px, mean, error in told]
        lower = [f"{px:.0f},{_y(mean - (error or 0)):.1f}" for px, mean, error in told]
        line = " ".join(f"{px:.0f},{_y(mean):.1f}" for px, mean, _ in told)
        parts.append(f'<polygon points="{" ".join([*upper, *reversed(lower)])}" fill="{_colour(i)}" opacity="0.15"/>')
        parts.append(f'<polyline points="{line}" fill="none" stroke="{_colour(i)}" stroke-width="2"/>')
    return _frame("".join(parts), curves, [(x(at), str(at)) for at in points])


def _y(percent: float) -> float:
    return 10 + (_HEIGHT - _BOTTOM - 10) * (1 - min(max(percent, 0.0), 100.0) / 100)


def _colour(i: int) -> str:
    return _COLOURS[i % len(_COLOURS)]


# The pages


def _as_html(blocks: Sequence[Block]) -> str:
    parts = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>playbyear-reproduce</title>',
        f"<style>{_STYLE}</style>",
    ]
    for block in blocks:
        text = html.escape(block.text)
        if block.kind in ("heading", "section"):
            parts.append(f"<h{1 + (block.kind == 'section')}>{text}</h{1 + (block.kind == 'section')}>")
        elif block.kind == "text":
            parts.append(f"<p>{text}</p>")
        elif block.kind == "figure":
            parts.append(f"<div>{block.text}</div>")
        elif block.kind == "film" and block.path is not None:
            data = base64.b64encode(block.path.read_bytes()).decode()
            source = f"data:video/mp4;base64,{data}"
            parts.append(
                f'<figure><video controls preload="none" src="{source}"></video><figcaption>{text}</figcaption></figure>'
            )
        elif block.kind == "code":
            parts.append(f"<details><summary>{html.escape(block.head[0])}</summary><pre>{text}</pre></details>")
        else:
            cells = "".join(f"<th>{html.escape(name)}</th>" for name in block.head)
            lines = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in block.rows]
            parts.append(f"<table><tr>{cells}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>")
    return "\n".join(parts) + "</html>\n"


def _as_markdown(blocks: Sequence[Block], folder: Path) -> str:
    parts = []
    for block in blocks:
        if block.kind in ("heading", "section"):
            parts.append(f"{'#' * (1 + (block.kind == 'section'))} {block.text}")
        elif block.kind == "text":
            parts.append(block.text)
        elif block.kind == "film" and block.path is not None:
            parts.append(f"[{block.text}]({block.path.relative_to(folder).as_posix()})")
        elif block.kind == "code":
            parts.append(f"{block.head[0]}\n\n```\n{block.text}\n```")
        elif block.kind in ("table", "curve"):
            lines = [block.head, ["---"] * len(block.head), *block.rows]
            parts.append("\n".join("| " + " | ".join(line) + " |" for line in lines))
    return "\n\n".join(parts) + "\n"
