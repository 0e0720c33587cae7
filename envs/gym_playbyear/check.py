"""Whether a task needs hearing: its expert, everyone who plays it deaf, and what twin worlds give away, in one table.

    python -m gym_playbyear.check OccludedGrasp-v1 --episodes=100 --output=check.json

The expert must solve the task. Blind scripts, which know what the camera shows and feel nothing, must not, nor must deaf
scripts, which feel with the arm; and nothing but sound may tell that the hidden object was touched. The exit status is 1
where a limit is broken.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from gym_playbyear.adversaries.players import EXPERT, KINDS, outcomes, players, promised_limits
from gym_playbyear.adversaries.progress import Progress
from gym_playbyear.adversaries.scripts import Outcome
from gym_playbyear.adversaries.twin import TwinError, TwinResult, twin_test
from gym_playbyear.task import Task

FIRST_SEED = 80000  # nothing was tuned on episodes from here on


@dataclass(frozen=True)
class Limits:
    """What a task promises. Shares of episodes; areas under curves.

    Attributes:
        expert: The expert solves at least this share.
        blind: No blind script solves more.
        deaf_margin: Nobody deaf solves more than this above the best blind script, or, where none is played, above `blind`.
        auc: No classifier tells twin worlds apart better.
    """

    expert: float = 0.95
    blind: float = 0.25
    deaf_margin: float = 0.10
    auc: float = 0.6


@dataclass(frozen=True)
class Row:
    """One player's result.

    Attributes:
        name, kind: Who played; `expert`, `blind`, `deaf`, or `learned`.
        successes, n_episodes: How often it solved the task.
        ends: How its attempts ended, and how often.
        limit: What it must reach (expert) or must not exceed, as a share; None before it is judged.
        holds: Whether it keeps to the limit.
    """

    name: str
    kind: str
    successes: int
    n_episodes: int
    ends: dict[str, int]
    limit: float | None = None
    holds: bool = True

    @property
    def rate(self) -> float:
        return self.successes / self.n_episodes


@dataclass(frozen=True)
class Report:
    """All of a task's results, and the limits that are broken, in words."""

    task: str
    options: dict[str, Any]
    first_seed: int
    rows: list[Row]
    twin: TwinResult | None
    limits: Limits
    broken: list[str]


def check(
    task: str | Task,
    n_episodes: int = 100,
    *,
    first_seed: int = FIRST_SEED,
    names: list[str] | None = None,
    twin: bool = True,
    jobs: int = 1,
    limits: Limits | None = None,
    learned: list[dict[str, Any]] | None = None,
    options: dict[str, Any] | None = None,
    progress: Path | None = None,
) -> Report:
    """Plays a task with everyone, and compares twin worlds.

    Args:
        task: Its name, such as `OccludedGrasp-v1`, or the task.
        n_episodes: Of each player, and of the twin test.
        first_seed: Of the episodes; they count up.
        names: Of the players; all by default.
        twin: Whether to compare twin worlds.
        jobs: Processes side by side.
        limits: What the task promises; by default what it says itself, or else `Limits()`.
        learned: Results of learned adversaries: `name`, `successes`, `n_episodes`, `hears`.
        options: Of `TaskEnv`.
        progress: A file of who has played already; a check that was stopped goes on from there.

    Raises:
        ValueError: A name is not among the task's players, or a learner's result is of another task.
    """
    name = task if isinstance(task, str) else task.name
    by_learners = [_row_of(result, name) for result in learned or []]
    options = options or {}
    limits = limits or Limits(**promised_limits(task, **options))
    known = players(task, **options)
    for player in names or []:
        if player not in known:
            raise ValueError(f"player={player!r} is not known: choose from {', '.join(map(repr, known))}.")
    chosen = {player: kind for player, kind in known.items() if not names or player in names}
    seeds = range(first_seed, first_seed + n_episodes)
    play = partial(outcomes, task, seeds=seeds, options=options)
    done = Progress(progress, {"task": name, "options": options, "seeds": [first_seed, n_episodes]})
    missing = [player for player in chosen if done.attempts(player) is None]
    found: TwinResult | None = None
    faults: list[str] = []
    if jobs > 1:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            pending = pool.submit(partial(twin_test, task, seeds, **options)) if twin else None
            for player, attempts in zip(missing, pool.map(play, missing), strict=True):
                done.keep(player, _told(player, attempts))
            if pending:
                found, faults = _compared(pending.result)
    else:
        for player in missing:
            done.keep(player, _told(player, play(player)))
        if twin:
            found, faults = _compared(partial(twin_test, task, seeds, **options))
    rows = []
    for player, kind in chosen.items():
        attempts = done.attempts(player) or []
        ends = dict(Counter(attempt.end for attempt in attempts).most_common())
        rows.append(Row(player, kind, sum(attempt.success for attempt in attempts), n_episodes, ends))
    judged = judge(rows + by_learners, limits)
    broken = [describe(row) for row in judged if not row.holds] + faults + twin_faults(found, limits)
    return Report(name, options, first_seed, judged, found, limits, broken)


def _row_of(result: dict[str, Any], task: str) -> Row:
    """A learned adversary's row."""
    if result.get("task", task) != task or not {"hears", "name", "successes", "n_episodes"} <= result.keys():
        raise ValueError(
            f"learned: {result.get('name', result.get('task'))!r} is no learner's result on {task!r}: give files that "
            "`python -m experiments.adversaries` wrote for it."
        )
    kind = "learned, hears" if result["hears"] else "learned, deaf"
    return Row(result["name"], kind, result["successes"], result["n_episodes"], {})


def _compared(compare: Callable[[], TwinResult]) -> tuple[TwinResult | None, list[str]]:
    """What twin worlds gave, or why they gave nothing."""
    try:
        return compare(), []
    except TwinError as error:
        return None, [str(error)]


def _told(name: str, attempts: list[Outcome]) -> list[Outcome]:
    """Says how far the check is."""
    print(f"{name}: {sum(attempt.success for attempt in attempts)} of {len(attempts)}", file=sys.stderr, flush=True)
    return attempts


def judge(rows: list[Row], limits: Limits) -> list[Row]:
    """Each row with its limit, and whether it keeps to it.

    A learned adversary that hears must exceed what nobody deaf may; else the deaf one's failure proves nothing.
    """
    blind = [row.rate for row in rows if row.kind == "blind"]
    above_blind = max(blind, default=limits.blind) + limits.deaf_margin
    wanted = {
        "expert": limits.expert,
        "blind": limits.blind,
        "deaf": above_blind,
        "learned, deaf": above_blind,
        "learned, hears": above_blind,
    }
    judged = []
    for row in rows:
        limit, must_reach = wanted[row.kind], row.kind in ("expert", "learned, hears")
        holds = row.rate >= limit - 1e-9 if must_reach else row.rate <= limit + 1e-9
        judged.append(Row(row.name, row.kind, row.successes, row.n_episodes, row.ends, limit, holds))
    return judged


def describe(row: Row) -> str:
    """A broken limit in words."""
    wanted = "at least" if row.kind in ("expert", "learned, hears") else "at most"
    return f"{row.name} ({row.kind}) solves {_percent(row.rate)}, {wanted} {_percent(row.limit)} was promised"


def twin_faults(twin: TwinResult | None, limits: Limits) -> list[str]:
    """What twin worlds give away and should not."""
    if twin is None:
        return []
    faults = [
        f"twin worlds: {name} tells them apart with an area of {spread.value:.2f}, at most {limits.auc:.2f} was promised"
        for name, spread in twin.auc.items()
        if spread.value > limits.auc
    ]
    if not twin.equal_until_touch:
        faults.append(f"twin worlds differ before the touch: {twin.first_difference}")
    return faults


def as_text(report: Report) -> str:
    """The table for people."""
    lines = [f"{report.task} {report.options or ''}".rstrip()]
    lines.append(f"{'player':<16}{'kind':<16}{'success':>16}{'limit':>8}  ends")
    for row in report.rows:
        low, high = binomtest(row.successes, row.n_episodes).proportion_ci(method="wilson")
        success = f"{_percent(row.rate)} ({100 * low:.0f}-{100 * high:.0f})"
        limit = "" if row.limit is None else _percent(row.limit)
        ends = ", ".join(f"{count} {end}" for end, count in row.ends.items())
        lines.append(f"{row.name:<16}{row.kind:<16}{success:>16}{limit:>8}  {ends}{'' if row.holds else '   BROKEN'}")
    if report.twin is not None:
        twin = report.twin
        same = "every observation but sound is the same" if twin.equal_until_touch else "OBSERVATIONS DIFFER"
        until, judged = ("until the touch", "after it") if twin.can_be_touched else ("to the end", "at any time")
        lines.append(f"twin worlds, {twin.n_episodes} episodes: {until} {same};")
        for name, spread in twin.auc.items():
            lines.append(f"  {judged}, {name}: area {spread.value:.3f} ({spread.low:.3f}-{spread.high:.3f})")
        if twin.can_be_touched:
            lines.append(f"  pictures that differ after it: {100 * twin.pictures_after_touch:.0f} %")
    lines += [f"broken: {fault}" for fault in report.broken] or ["all limits hold"]
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.0f} %"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m gym_playbyear.check", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", help="such as OccludedGrasp-v1")
    parser.add_argument("--episodes", type=int, default=100, help="of each player and of the twin test (default: 100)")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help=f"of the first episode (default: {FIRST_SEED})")
    parser.add_argument(
        "--players", nargs="+", help=f"only these: {EXPERT}, or names of {' and '.join(KINDS[1:])} scripts"
    )
    parser.add_argument("--no-twin", action="store_true", help="do not compare twin worlds")
    parser.add_argument("--jobs", type=int, default=1, help="processes side by side (default: 1)")
    parser.add_argument("--horizon", type=int, help="steps of an episode; by default the task's own")
    parser.add_argument("--learned", type=Path, nargs="+", default=[], help="results of experiments.adversaries")
    parser.add_argument("--output", type=Path, help="a JSON file for the results; a check that was stopped goes on")
    arguments = parser.parse_args()
    given = {"horizon": arguments.horizon}
    progress = None
    if arguments.output:  # before the hours that it takes
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        progress = arguments.output.with_suffix(".partial")
    report = check(
        arguments.task,
        arguments.episodes,
        first_seed=arguments.seed,
        names=arguments.players,
        twin=not arguments.no_twin,
        jobs=arguments.jobs,
        learned=[json.loads(path.read_text()) for path in arguments.learned],
        options={name: value for name, value in given.items() if value is not None},
        progress=progress,
    )
    print(as_text(report))
    if progress is not None:
        arguments.output.write_text(json.dumps(asdict(report), indent=1) + "\n")
        progress.unlink(missing_ok=True)
    return 1 if report.broken else 0


if __name__ == "__main__":
    sys.exit(main())
