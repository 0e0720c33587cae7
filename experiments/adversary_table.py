"""The table of who solves which task without hearing, beside the results: `python -m experiments.adversary_table`.

It is made of the results in experiments/results/adversaries: those of `python -m gym_playbyear.check TASK`
(`TASK-check.json`) and those of `python examples/learned_adversary/learn.py` (`TASK-deaf-...json`, `TASK-hears-...json`).
"""

from pathlib import Path
from typing import Any

import gym_playbyear
from experiments.protocol import RESULTS, load

FOLDER = RESULTS / "adversaries"
PAGE = FOLDER / "README.md"
BEGIN, END = "<!-- table of adversaries -->\n", "<!-- end of the table -->\n"
NOT_RUN, NOT_THERE = "not run", ""
_LEARNED = {"deaf": "learned, deaf", "hears": "learned, hears"}
_CLASSIFIER = "logistic regression"
_FORMER = (
    "tap_gentle",
    "tap_feather",
    "tap_along",
    "tap_across",
    "shove",
    "bat",
    "nudge_beside",
    "poke",
    "gather",
    "survive",
)
"""Scripts that never led, and are not played any more; the committed results have them."""


def checks(folder: Path = FOLDER) -> dict[str, dict[str, Any]]:
    """The saved result of each task's check, in the order of the tasks; empty where there is none."""
    paths = {task: folder / f"{task}-check.json" for task in gym_playbyear.TASKS}
    return {task: load(path) if path.exists() else {} for task, path in paths.items()}


def learned(task: str, sense: str, check: dict[str, Any], folder: Path = FOLDER) -> str:
    """What a task's learned adversaries reach, `deaf` or `hears`, after how many steps; of several, each with its teacher.

    Bold where a deaf one reaches more than the deaf may, or one that hears does not.
    """
    results = [load(path) for path in sorted(folder.glob(f"{task}-{sense}-*.json"))]
    cells = []
    for result in results:
        teacher = f"{result['options']['teacher']}, " if len(results) > 1 else ""
        rate = result["successes"] / result["n_episodes"]
        is_above = bool(check) and rate > _most_of_the_deaf(check)
        text = _percent(rate) if is_above == (sense == "hears") or not check else f"**{_percent(rate)}**"
        cells.append(f"{text} ({teacher}{result['steps'] / 1000:,.0f}k steps)")
    return "; ".join(cells) or NOT_RUN


def table(folder: Path = FOLDER) -> str:
    """The table in Markdown: a column for each task, a row for each player."""
    found = checks(folder)
    rows = [("episodes", [_episodes(check) for check in found.values()])]
    for kind, name in _players(found):
        label = name if kind == name else f"{kind}: `{name}`"
        rows.append((label, [_rate(check, kind, name) for check in found.values()]))
    rows += [
        (label, [learned(task, sense, check, folder) for task, check in found.items()])
        for sense, label in _LEARNED.items()
    ]
    rows.append(("most that is allowed to the deaf", [_allowed(check) for check in found.values()]))
    rows += _twin_rows(list(found.values()))
    rows.append(("limits that are broken", [_broken(check) for check in found.values()]))
    head = "| player | " + " | ".join(f"`{task}`" for task in found) + " |"
    lines = [head, "|---" * (len(found) + 1) + "|", *(f"| {label} | {' | '.join(cells)} |" for label, cells in rows)]
    return "\n".join(lines) + "\n"


def _players(found: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Kind and name of everyone who played, the expert first, each once."""
    all_rows = [row for check in found.values() for row in check.get("rows", [])]
    kinds = ("expert", "blind", "deaf")
    played = dict.fromkeys((kind, row["name"]) for kind in kinds for row in all_rows if row["kind"] == kind)
    return [(kind, name) for kind, name in played if name not in _FORMER]


def _episodes(check: dict[str, Any]) -> str:
    return str(check["rows"][0]["n_episodes"]) if check else NOT_RUN


def _rate(check: dict[str, Any], kind: str, name: str) -> str:
    """Success of a player; bold where it breaks its limit."""
    for row in check.get("rows", []):
        if (row["kind"], row["name"]) == (kind, name):
            rate = _percent(row["successes"] / row["n_episodes"])
            return rate if row["holds"] else f"**{rate}**"
    return NOT_THERE


def _allowed(check: dict[str, Any]) -> str:
    return _percent(_most_of_the_deaf(check)) if check else NOT_THERE


def _most_of_the_deaf(check: dict[str, Any]) -> float:
    """The best blind script's success, and the margin."""
    blind = [row["successes"] / row["n_episodes"] for row in check["rows"] if row["kind"] == "blind"]
    return max(blind) + float(check["limits"]["deaf_margin"])


def _twin_rows(found: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """What twin environments give away."""
    twins = [check.get("twin") for check in found]
    same = [NOT_RUN if twin is None else "same" if twin["equal_until_touch"] else "**differ**" for twin in twins]
    rows = [("twin environments: observations but sound, until the touch", same)]
    areas = [NOT_RUN if twin is None else f"{twin['auc'].get(_CLASSIFIER, twin['auc'])['value']:.2f}" for twin in twins]
    rows.append((f"twin environments: area of {_CLASSIFIER}, after it", areas))
    return rows


def _broken(check: dict[str, Any]) -> str:
    return str(len(check["broken"]) or "none") if check else NOT_RUN


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def with_table(text: str, made: str) -> str:
    """A page with its table replaced.

    Raises:
        ValueError: The page has no place for it.
    """
    if BEGIN not in text or END not in text:
        raise ValueError(
            f"{PAGE.name} has no lines {BEGIN.strip()!r} and {END.strip()!r}: put them where the table belongs."
        )
    before, rest = text.split(BEGIN)
    return before + BEGIN + "\n" + made + "\n" + END + rest.split(END)[1]


def main() -> None:
    made = table()
    PAGE.write_text(with_table(PAGE.read_text(), made))
    print(made, end="")


if __name__ == "__main__":
    main()
