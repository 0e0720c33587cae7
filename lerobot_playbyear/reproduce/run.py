"""Does the cells of the plan: those that are missing, each once, whoever else is at it."""

import json
import os
import signal
import statistics
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import batched
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.errors import InputError, PlaybyearError, printable
from lerobot_playbyear.datasets.files import FolderLock, FolderLockedError, parse_json, write_atomically
from lerobot_playbyear.reproduce.config import ReproduceConfig
from lerobot_playbyear.reproduce.plan import Candidate, Cell, Plan, Step
from lerobot_playbyear.reproduce.steps import StepError, carry_out, forked, prepare
from lerobot_playbyear.reproduce.table import KEY, N_BEST, Row, Table, machine, rate, told, versions

_DONE, _FAILED, _BUSY = 0, 1, 3


def reproduce(cfg: ReproduceConfig) -> None:
    """Does what `cfg.action` says.

    Raises:
        InputError: An option has no meaning.
        StepError: A cell could not be done; all others were.
    """
    cfg.check()
    table = Table(cfg.results)
    if cfg.action == "merge":
        assert cfg.folder is not None
        print(f"{table.merge(Table(cfg.folder))} rows taken in from {cfg.folder}. See them: playbyear-reproduce status")
        return
    plan = Plan(cfg.size, cfg.output_dir, cfg.plan, cfg.device)
    cells = plan.chosen(cfg.only)
    if cfg.action == "plan":
        print_plan(cells, table)
    elif cfg.action == "status":
        print_status(cells, table)
    elif cfg.action == "run":
        run(cells, cfg)
    else:
        from lerobot_playbyear.reproduce.report import write_report

        for path in write_report(plan, table):
            print(f"Report: {path}")


# Running


def run(cells: Sequence[Cell], cfg: ReproduceConfig) -> None:
    """Does what is missing, `cfg.jobs` cells at a time.

    Raises:
        StepError: With the names of the cells that failed.
    """
    table = Table(cfg.results)
    missing = [cell for cell in cells if not is_done(cell, table)]
    print(f"{len(cells)} cells of size {cfg.size}, {len(cells) - len(missing)} of them done.", flush=True)
    outcomes = _submitted(missing, cfg) if cfg.cluster else _forked(missing, cfg)
    failed = [cell.name for cell, outcome in outcomes if outcome not in (_DONE, _BUSY)]
    busy = sum(outcome == _BUSY for _, outcome in outcomes)
    if busy:
        print(f"{busy} cells are at work in another run.")
    print(f"Results: {cfg.results}\nReport:  playbyear-reproduce report --size={cfg.size}")
    if failed:
        raise StepError(f"{len(failed)} cells failed: {', '.join(failed)}. The same command tries them again.")


def is_done(cell: Cell, table: Table) -> bool:
    return table.get(*(getattr(cell, name) for name in KEY)) is not None


def _forked(cells: Sequence[Cell], cfg: ReproduceConfig) -> list[tuple[Cell, int]]:
    """Each cell in a fork of this process; with what became of it."""
    _prepare_for(cells)
    waiting, outcomes = list(cells), []
    running: dict[int, Cell] = {}
    try:
        while waiting or running:
            while waiting and len(running) < cfg.jobs:
                cell = waiting.pop(0)
                running[forked(partial(work, cell, cfg))] = cell
            pid, status = os.wait()
            if pid in running:
                outcomes.append((running.pop(pid), os.waitstatus_to_exitcode(status)))
    finally:
        for pid in running:
            os.kill(pid, signal.SIGTERM)
    return outcomes


def _submitted(cells: Sequence[Cell], cfg: ReproduceConfig) -> list[tuple[Cell, int]]:
    """Each cell as a job of submitit's; with what became of it.

    Raises:
        InputError: submitit is not installed.
    """
    try:
        import submitit
    except ImportError as error:
        raise InputError("--cluster needs submitit: pip install 'lerobot_policy_playbyear[cluster]'.") from error
    executor = submitit.AutoExecutor(cfg.output_dir / "jobs", cluster=cfg.cluster)
    executor.update_parameters(timeout_min=cfg.minutes, cpus_per_task=cfg.threads, name="playbyear")
    if cfg.cluster == "slurm":
        executor.update_parameters(slurm_partition=cfg.partition, slurm_array_parallelism=cfg.jobs)
    n_at_once, jobs = len(cells) if cfg.cluster == "slurm" else cfg.jobs, []
    for at_once in batched(cells, max(n_at_once, 1)):
        with executor.batch():
            submitted = [executor.submit(work_alone, cell.name, cfg) for cell in at_once]
        jobs += submitted
        for job in submitted:
            job.wait()
    return [(cell, _FAILED if job.exception() else job.result()) for cell, job in zip(cells, jobs, strict=True)]


def work_alone(name: str, cfg: ReproduceConfig) -> int:
    """A cell in a process that has imported nothing yet. Returns what became of it."""
    cells = Plan(cfg.size, cfg.output_dir, cfg.plan, cfg.device).cells
    cell = next(cell for cell in cells if cell.name == name)
    _prepare_for([cell])
    return work(cell, cfg)


def _prepare_for(cells: Sequence[Cell]) -> None:
    if any(step.command[0] != "python" for cell in cells for step in cell.steps):
        prepare()


def work(cell: Cell, cfg: ReproduceConfig) -> int:
    """Does a cell and says so. Returns what became of it."""
    start = time.monotonic()
    failure = cell.folder / "failed.json"
    try:
        row = do(cell, Table(cfg.results), cfg.threads)
    except FolderLockedError:
        return _BUSY
    except Exception as error:
        told = str(error) if isinstance(error, PlaybyearError) else traceback.format_exc()
        write_atomically(failure, json.dumps({"error": told}, indent=1))
        print(printable(f"FAILED {cell.name}: {told}"), flush=True)
        return _FAILED
    failure.unlink(missing_ok=True)
    if row is not None:
        print(f"{cell.name}: {summary(row)}, {(time.monotonic() - start) / 60:.1f} min", flush=True)
    return _DONE


def do(cell: Cell, table: Table, threads: int = 1) -> Row | None:
    """Does what is missing of a cell, and adds its row to the table.

    Returns:
        The row; None if another run has added it.

    Raises:
        FolderLockedError: Another run is at it.
        StepError: A command failed.
    """
    with FolderLock(cell.folder / ".lock", f"{cell.name} is at work in another run."):
        if is_done(cell, table):
            return None
        minutes: dict[str, float] = {}
        commands: list[str] = []

        def carry(step: Step) -> Path:
            minutes[step.name] = minutes.get(step.name, 0.0) + carry_out(step, threads)
            commands.append(step.shown)
            return step.folder

        for step in cell.steps:
            carry(step)
        row = _evaluated(cell, carry) if cell.candidates else _of_players(cell)
        size = {key: cell.values[key] for key in ("n", "steps", "kept", "n_held_out") if key in cell.values}
        row = {**{name: getattr(cell, name) for name in KEY}, **row, "values": size, "commands": commands}
        row |= {"minutes": {name: round(spent, 2) for name, spent in minutes.items()}, "threads": threads}
        row |= {"versions": versions(), "machine": machine()}
        table.put([row])
        return row


def _evaluated(cell: Cell, carry: Any) -> Row:
    """What a policy is worth: its checkpoints on seeds of choice, the best three and the last on held-out ones."""

    def tried(purpose: str, candidate: Candidate) -> Row:
        folder = carry(cell.evaluation(purpose, candidate))
        return told(folder / "attempts.jsonl", cell.values[f"seed_{purpose}"], cell.values[f"n_{purpose}"])

    there = [each for each in cell.candidates if each.path.exists()]  # a run may end before its last round
    curve = [] if len(there) < 2 else [(each, tried("choice", each)["successes"]) for each in there]
    ranked = sorted(curve, key=lambda point: (rate(point[1]), point[0].at))
    best = [candidate for candidate, _ in ranked[-N_BEST:]]
    scored = {each.name: tried("held_out", each) for each in dict.fromkeys([*best, there[-1]])}
    last = scored[there[-1].name]
    if int(cell.seed) == int(cell.plan.text["sizes"][cell.size]["seeds"][0]):
        _film(cell, last, carry)
    return {
        **last,
        "curve": [{"at": each.at, "choice": successes} for each, successes in curve],
        "best": {each.name: scored[each.name]["successes"] for each in best},
        "expert": _expert(cell),
    }


def _film(cell: Cell, last: Row, carry: Any) -> None:
    """One of each way to fail, of the first episode that failed so."""
    candidate = cell.candidates[-1]
    if cell.steps[-1].name == "residual":
        return
    path = cell.evaluation("held_out", candidate).folder / "attempts.jsonl"
    lines = [parse_json(line) for line in path.read_text().splitlines()]
    for mode in last["failures"]:
        failed = [line["seed"] for line in lines if line.get("failure", line["end"]) == mode and not line["is_success"]]
        carry(cell.film(str(mode).replace(", ", "_").replace(" ", "_"), min(failed)))


def _expert(cell: Cell) -> Row:
    """What the expert of a policy spent; empty without one."""
    taught = [step.folder for step in cell.steps if step.command[0] == "playbyear-dagger"]
    if not taught:
        return {}
    from lerobot_playbyear.dagger.report import totals_of  # imports LeRobot, which such a cell has imported already
    from lerobot_playbyear.dagger.run_folder import RunFolder

    attempts = [line for folder in taught for line in RunFolder(folder).metrics() if line.get("kind") == "attempt"]
    if not attempts:
        return {}
    totals = totals_of(attempts)
    return {
        "kept": sum(line.get("outcome") == "kept" for line in attempts),
        "attempts": totals["attempts"],
        "steps": totals["expert_steps"],
        "takeovers": totals["takeovers"],
        "person_minutes": round(totals["person_seconds"] / 60, 1),
    }


def _of_players(cell: Cell) -> Row:
    """What scripts and learned players reach: each with its kind, successes and ends."""
    report = parse_json((cell.steps[-1].folder / "check.json").read_bytes())
    rows = report.get("rows") or [{**report, "kind": "learned, hears" if report["hears"] else "learned, deaf"}]
    names = ("kind", "successes", "n_episodes", "ends")
    players = {row["name"]: {name: row[name] for name in names if name in row} for row in rows}
    return {"first_seed": report["first_seed"], "players": players}


# Telling


def summary(row: Row) -> str:
    """A row in a few words."""
    if "players" in row:
        shares = {name: 100 * each["successes"] / each["n_episodes"] for name, each in row["players"].items()}
        return ", ".join(f"{name} {share:.0f} %" for name, share in shares.items())
    return f"{rate(row['successes']):.0f} % of {len(row['successes'])}"


def print_plan(cells: Sequence[Cell], table: Table) -> None:
    """The commands of every cell, each where it is first needed, and what they will cost by the rows that are there."""
    measured: dict[str, list[float]] = {}
    for name, minutes in (item for row in table.rows(cells[0].size) for item in row.get("minutes", {}).items()):
        measured.setdefault(name, []).append(minutes)
    known: set[Path] = set()
    needed: Counter[str] = Counter()
    for cell in cells:
        print(f"\n# {printable(cell.name, '')}{' (done)' if is_done(cell, table) else ''}")
        candidates = cell.candidates
        choice = [cell.evaluation("choice", each) for each in candidates] if len(candidates) > 1 else []
        for step in (*cell.steps, *choice, *(cell.evaluation("held_out", each) for each in candidates)):
            if step.folder in known:
                print(f"# as above: {printable(step.folder, '')}")
                continue
            known.add(step.folder)
            is_sure = "held_out" not in step.folder.name or step.folder.name.endswith("-last")
            print(printable(step.shown if is_sure else f"# if it is among the best {N_BEST}:\n{step.shown}"))
            needed[step.name] += not is_done(cell, table)
    cost = sum(n * statistics.median(measured[name]) for name, n in needed.items() if name in measured)
    print(f"\n{len(cells)} cells. What is missing takes about {cost / 60:.1f} hours of a core.")
    if unknown := sorted(needed.keys() - measured.keys()):
        print(f"Not measured yet, and not counted: {printable(', '.join(unknown))}.")


def print_status(cells: Sequence[Cell], table: Table) -> None:
    """How many cells of each study are done, and which failed."""
    counts: dict[str, Counter[str]] = {}
    for cell in cells:
        state = "done" if is_done(cell, table) else "failed" if (cell.folder / "failed.json").exists() else "missing"
        counts.setdefault(cell.study, Counter())[state] += 1
        if state == "failed":
            error = str(parse_json((cell.folder / "failed.json").read_bytes())["error"])
            print(printable(f"failed: {cell.name}: {error}").splitlines()[0])
    for study, states in counts.items():
        print(printable(f"{study:<16}") + ", ".join(f"{n} {state}" for state, n in states.items()))
