"""Plays a task with everyone who tries it, compares twin environments, and judges the results by what the task promises."""

import json
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from gym_playbyear.check.deaf import DeafTask, DeafView, ScriptMaker
from gym_playbyear.check.occluded import SCRIPTS
from gym_playbyear.check.twins import TwinError, TwinResult, Twins, twin_test
from gym_playbyear.task import Task, unknown_name

_SCRIPT_STREAM = 11  # tells a script's random numbers from the sensors' with the same seed


EXPERT = "expert"
KINDS = (EXPERT, "blind", "deaf")


def players(deaf_task: DeafTask) -> dict[str, str]:
    """The names of a task's players, each with its kind."""
    blind, deaf = list(deaf_task.env.definition.blind), list(deaf_scripts(deaf_task))
    return {EXPERT: EXPERT, **dict.fromkeys(blind, "blind"), **dict.fromkeys(deaf, "deaf")}


def deaf_scripts(deaf_task: DeafTask) -> dict[str, ScriptMaker]:
    """The deaf scripts that know how to play a task.

    A task brings its own (`Task.deaf`). Those that are for all look for an object on a line.
    """
    deaf_task.begin(0)
    return dict(deaf_task.env.definition.deaf) or (SCRIPTS if "hidden_range" in deaf_task.env.shown else {})


def play(task: DeafTask, make_script: ScriptMaker, seed: int, **options: Any) -> str:
    """Plays one attempt of a deaf script. How it ended: "success", "time", or what the task calls it.

    Args:
        task: The task as a deaf player meets it.
        make_script: One of `occluded.SCRIPTS`, of `Task.deaf`, or your own.
        seed: Of the episode.
        options: Of the environment's reset.
    """
    view = task.begin(seed, **options)
    script = make_script(task.facts, np.random.default_rng([seed, _SCRIPT_STREAM]))
    return _finish(task, view, script.act)


def _finish(task: DeafTask, view: DeafView, act: Callable[[DeafView], np.ndarray]) -> str:
    """Plays an attempt that was begun to its end."""
    done = False
    while not done:
        view, done, info = task.advance(act(view))
    return "success" if info["is_success"] else str(info["end"])


def outcomes(task: str | Task, name: str, seeds: range, options: dict[str, Any] | None = None) -> list[str]:
    """How a player's attempts end, one for each seed.

    Args:
        task: Its name, or the task.
        name: Of the player.
        seeds: Of the episodes.
        options: Of `TaskEnv`.
    """
    deaf_task = DeafTask(task, **(options or {}))
    scripts, ends = deaf_scripts(deaf_task), []
    for seed in seeds:
        if name in scripts:
            ends.append(play(deaf_task, scripts[name], seed))
        else:
            ends.append(_play_behind_the_scenes(deaf_task, name, seed))
    deaf_task.close()
    return ends


def _play_behind_the_scenes(deaf_task: DeafTask, name: str, seed: int) -> str:
    """Plays an attempt of a script that looks at the environment: the expert, or a blind one."""
    view, env = deaf_task.begin(seed), deaf_task.env
    script = env.scripted_expert() if name == EXPERT else env.blind_baselines()[name]
    return _finish(deaf_task, view, lambda _: script.act())


class Progress:
    """How finished players' attempts ended, kept in a file for a check that is stopped.

    Args:
        path: Of the file; None: nothing is kept.
        settings: Task, options and seeds. What was played with others is forgotten.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any]):
        self.path, self.settings = path, json.loads(json.dumps(settings))
        self.played: dict[str, list[str]] = {}
        kept = json.loads(path.read_text()) if path is not None and path.exists() else {}
        if kept.get("settings") == self.settings and kept["played"]:
            self.played = kept["played"]
            names = ", ".join(self.played)
            told = f"{path} has {names} of a check that was stopped: they do not play again. Remove it if the task has changed."
            print(told, file=sys.stderr)

    def keep(self, player: str, ends: list[str]) -> None:
        """Writes down how a player's attempts ended, and says how far the check is."""
        print(f"{player}: {ends.count('success')} of {len(ends)}", file=sys.stderr, flush=True)
        self.played[player] = ends
        if self.path is not None:
            new = self.path.with_suffix(".new")
            new.write_text(json.dumps({"settings": self.settings, "played": self.played}))
            new.replace(self.path)


FIRST_SEED = 80000  # nothing was tuned on episodes from here on


@dataclass(frozen=True)
class Limits:
    """What a task promises. Shares of episodes; areas under curves.

    Attributes:
        expert: The expert solves at least this share.
        blind: No blind script solves more.
        deaf_margin: Nobody deaf solves more than this above the best blind script, or, where none is played, above `blind`.
        auc: No classifier tells twin environments apart better that does not hear.
        heard: One that hears tells them apart at least so well.
    """

    expert: float = 0.95
    blind: float = 0.25
    deaf_margin: float = 0.10
    auc: float = 0.6
    heard: float = 0.8


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
    """Plays a task with everyone, and compares twin environments.

    Args:
        task: Its name, such as `OccludedGrasp-v1`, or the task.
        n_episodes: Of each player, and of the twin test.
        first_seed: Of the episodes; they count up.
        names: Of the players, or of their kinds (`KINDS`); all by default.
        twin: Whether to compare twin environments.
        jobs: Processes side by side.
        limits: What the task promises; by default what it says itself, or else `Limits()`.
        learned: Results of learned adversaries: `name`, `successes`, `n_episodes`, `hears`.
        options: Of `TaskEnv`.
        progress: A file of who has played already; a check that was stopped goes on from there.

    Raises:
        ValueError: A name is not among the task's players, or a learner's result is of another task; or its twin environments
            cannot be made with the task's options.
    """
    name = task if isinstance(task, str) else task.name
    by_learners = [_row_of(result, name) for result in learned or []]
    options = options or {}
    deaf_task = DeafTask(task, **options)
    definition = deaf_task.env.definition
    for limit in definition.limits:
        if limit not in Limits.__dataclass_fields__:
            raise unknown_name(f"{definition.name}: limits, limit", limit, Limits.__dataclass_fields__)
    known, limits = players(deaf_task), limits or Limits(**definition.limits)
    deaf_task.close()
    for player in names or []:
        if player not in known and player not in KINDS:
            raise ValueError(f"player={player!r} is not known: choose from {', '.join(map(repr, known))}.")
    if twin:
        with suppress(TwinError):  # told after who played
            Twins(task, **options).close()  # an option that there is not, before anyone plays
    chosen = {player: kind for player, kind in known.items() if not names or {player, kind} & set(names)}
    seeds = range(first_seed, first_seed + n_episodes)
    play = partial(outcomes, task, seeds=seeds, options=options)
    done = Progress(progress, {"task": name, "options": options, "seeds": [first_seed, n_episodes]})
    missing = [player for player in chosen if player not in done.played]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) if jobs > 1 else nullcontext() as pool:
        for player, ends in zip(missing, (pool.map if pool else map)(play, missing), strict=True):
            done.keep(player, ends)
    found: TwinResult | None = None
    faults: list[str] = []
    if twin:
        try:
            found = twin_test(task, seeds, **options)
        except TwinError as error:
            faults = [str(error)]
    rows = []
    for player, kind in chosen.items():
        counted = dict(Counter(done.played[player]).most_common())
        rows.append(Row(player, kind, counted.get("success", 0), n_episodes, counted))
    judged = judge(rows + by_learners, limits)
    broken = [describe(row) for row in judged if not row.holds] + faults + twin_faults(found, limits)
    return Report(name, options, first_seed, judged, found, limits, broken)


def _row_of(result: dict[str, Any], task: str) -> Row:
    """A learned adversary's row."""
    if result.get("task", task) != task or not {"hears", "name", "successes", "n_episodes"} <= result.keys():
        raise ValueError(
            f"learned: {result.get('name', result.get('task'))!r} is not a learner's result on {task!r}: give files that "
            "`python examples/learned_adversary/learn.py` wrote for it."
        )
    kind = "learned, hears" if result["hears"] else "learned, deaf"
    return Row(result["name"], kind, result["successes"], result["n_episodes"], {})


def judge(rows: list[Row], limits: Limits) -> list[Row]:
    """Each row with its limit, and whether it keeps to it.

    A learned adversary that hears must exceed what nobody deaf may; else the deaf one's failure proves nothing.
    """
    blind = [row.rate for row in rows if row.kind == "blind"]
    above_blind = max(blind, default=limits.blind) + limits.deaf_margin
    wanted = {"expert": limits.expert, "blind": limits.blind}
    judged = []
    for row in rows:
        limit, must_reach = wanted.get(row.kind, above_blind), row.kind in ("expert", "learned, hears")
        holds = row.rate >= limit - 1e-9 if must_reach else row.rate <= limit + 1e-9
        judged.append(replace(row, limit=limit, holds=holds))
    return judged


def describe(row: Row) -> str:
    """A broken limit in words."""
    wanted = "at least" if row.kind in ("expert", "learned, hears") else "at most"
    return f"{row.name} ({row.kind}) solves {_percent(row.rate)}, {wanted} {_percent(row.limit)} was promised"


def twin_faults(twin: TwinResult | None, limits: Limits) -> list[str]:
    """What twin environments give away and should not, and what they do not tell by sound."""
    if twin is None:
        return []
    area, heard = twin.auc.value, twin.heard.value
    faults = []
    if area > limits.auc:
        faults.append(f"twin environments: a classifier's area is {area:.2f}, at most {limits.auc:.2f} was promised")
    if not twin.equal_until_touch:
        faults.append(f"twin environments differ before the touch: {twin.first_difference}")
    if heard < limits.heard:
        faults.append(
            f"twin environments sound alike: by sound a classifier's area is {heard:.2f}, at least {limits.heard:.2f} was "
            "promised. Hearing cannot tell what is hidden, or the expert's first touch differs between episodes"
        )
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
        lines.append(f"twin environments, {twin.n_episodes} episodes: {until} {same};")
        for who, area in (("", twin.auc), (" that hears", twin.heard)):
            lines.append(f"  {judged}, a classifier{who}: area {area.value:.3f} ({area.low:.3f}-{area.high:.3f})")
        if twin.can_be_touched:
            lines.append(f"  pictures that differ after it: {100 * twin.pictures_after_touch:.0f} %")
    lines += [f"broken: {fault}" for fault in report.broken] or ["all limits hold"]
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.0f} %"
