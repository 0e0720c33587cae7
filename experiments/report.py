"""The results as tables in Markdown: `python -m experiments.report`."""

import json
from collections import defaultdict

from experiments.protocol import (
    ATTEMPT_STEPS,
    CONDITIONS,
    RESULTS,
    RUN_LENGTHS,
    TASKS,
    Result,
    load_results,
    wilson_interval,
)


def percent(results: list[Result]) -> str:
    """Rate over all episodes of some policies, with its 95 % interval, and the rate of each policy."""
    successes = [success for result in results for success in result.successes]
    low, high = wilson_interval(sum(successes), len(successes))
    each = ", ".join(f"{100 * result.rate:.0f}" for result in results)
    return f"**{100 * sum(successes) / len(successes):.0f} %** ({100 * low:.0f} to {100 * high:.0f}) | {each}"


def ablation_table(task: str) -> list[str]:
    lines = [
        f"### {task}",
        "",
        "| policy | success (95 % interval) | training seeds | minutes of training |",
        "|---|---|---|---|",
    ]
    for condition in CONDITIONS:
        results = load_results(f"ablations/{task}-{condition}-*.json")
        if results:
            minutes = ", ".join(f"{result.minutes:.0f}" for result in results)
            lines.append(f"| {condition} | {percent(results)} | {minutes} |")
    blind = RESULTS / "ablations" / f"{task}-blind.json"
    if blind.exists():
        rates = json.loads(blind.read_text())["success"]
        expert = rates.pop("expert")
        name, best = max(rates.items(), key=lambda item: item[1])
        low, high = wilson_interval(round(100 * best), 100)
        lines.append(f"| best blind script (`{name}`) | **{best:.0%}** ({100 * low:.0f} to {100 * high:.0f}) | | |")
        lines.append(f"| expert that feels contact | {expert:.0%} | | |")
    return [*lines, ""]


def curve_table(study: str, task: str) -> list[str]:
    by_value: dict[str, list[Result]] = defaultdict(list)
    for result in load_results(f"{study}/{task}-*.json"):
        by_value[", ".join(result.environment.values())].append(result)
    if not by_value:
        return []
    lines = [f"### {task}: {study}", "", f"| {study} | success (95 % interval) | training seeds |", "|---|---|---|"]
    return [
        *lines,
        *(f"| {value} | {percent(results)} |" for value, results in sorted(by_value.items(), key=_order)),
        "",
    ]


def demonstration_table(task: str) -> list[str]:
    results = load_results(f"demonstrations/{task}-*.json")
    if not results:
        return []
    seed = results[0].training_seed
    results += [r for r in load_results(f"ablations/{task}-*demos-*.json") if r.training_seed == seed]
    lines = [f"### {task}: demonstrations", "", "| demonstrations | full | deaf |", "|---|---|---|"]
    for n in sorted({result.n_demonstrations for result in results}):
        row = {r.condition: f"{r.rate:.0%}" for r in results if r.n_demonstrations == n}
        lines.append(f"| {n} | {row.get('full', '')} | {row.get('deaf', '')} |")
    return [*lines, ""]


def listening_table() -> list[str]:
    lines = [
        "### Listening",
        "",
        "| policy | false contact | nothing swapped | muted contact | closed at the false contact |",
    ]
    lines.append("|---|---|---|---|---|")
    paths = sorted((RESULTS / "listening").glob("*.json"))
    for path in paths:
        report = json.loads(path.read_text())
        cells = [f"{report[mode]['n_reacted']} of {report[mode]['n_trials']}" for mode in ("false", "control", "muted")]
        closed = f"{report['false']['n_closed_there']} of {report['false']['n_trials']}"
        lines.append(f"| {path.stem} | {' | '.join(cells)} | {closed} |")
    return [*lines, ""] if paths else []


def correction_table() -> list[str]:
    """What corrections are worth, in the time of the attempts and in the task's own, and where the time of a round goes."""
    reports = [json.loads(path.read_text()) for path in sorted((RESULTS / "corrections").glob("*.json"))]
    if not reports:
        return []
    lines = [
        "### Corrections",
        "",
        "| task, demonstrations, updates, training seed | time | before | corrected | control | updates | minutes |",
    ]
    lines.append("|---|---|---|---|---|---|---|")
    for report in reports:
        before, after = report["evaluations"][0], report["evaluations"][-1]
        name = f"{report['task']}, {report['n_demonstrations']}, {report['steps']}, {report['training_seed']}"
        cost = f"{report['updates']} | {report['minutes']['dagger']:.0f}"
        for steps, key in (("the task's own", "in_task_time"), (ATTEMPT_STEPS[report["task"]], "success")):
            rates = f"{before[key]:.0f} % | **{after[key]:.0f} %** | {report['control'][key]:.0f} %"
            lines.append(f"| {name} | {steps} | {rates} | {cost} |")
    names = sorted({name for report in reports for name in report["seconds"]} - {"total_s"})
    lines += ["", f"| share of a round | {' | '.join(name.removesuffix('_s') for name in names)} | all of it |"]
    lines.append("|---" * (len(names) + 2) + "|")
    for report in reports:
        total = report["seconds"]["total_s"]
        cells = [f"{report['seconds'].get(name, 0) / total:.1%}" for name in names]
        lines.append(f"| {report['task']} | {' | '.join(cells)} | {total:.0f} s |")
    return [*lines, ""]


def run_length_table(task: str) -> list[str]:
    """What windows that share encodings teach, beside windows that do not: as many of them, and what they took."""
    lines = []
    for length in RUN_LENGTHS:
        results = load_results(f"run_length/{task}-full-k{length}-*.json")
        if results:
            paths = (RESULTS / "run_length" / "held_out_loss").glob(f"{task}-full-k{length}-*.json")
            losses = ", ".join(f"{json.loads(path.read_text()):.4f}" for path in sorted(paths))
            minutes = ", ".join(f"{result.minutes:.1f}" for result in results)
            lines.append(f"| {length} | {percent(results)} | {losses} | {minutes} |")
    if not lines:
        return []
    head = [
        f"### {task}: windows per run, K",
        "",
        "| K | success (95 % interval) | training seeds | held-out loss | minutes |",
    ]
    return [*head, "|---|---|---|---|---|", *lines, ""]


def _order(item: tuple[str, list[Result]]) -> tuple[float, str]:
    try:
        return float(item[0]), ""
    except ValueError:
        return 0.0, item[0]


def main() -> None:
    lines: list[str] = []
    for task in TASKS:
        lines += ablation_table(task)
    lines += listening_table()
    for task in TASKS:
        lines += demonstration_table(task)
        lines += curve_table("noise", task) + curve_table("materials", task) + run_length_table(task)
    print("\n".join(lines + correction_table()))


if __name__ == "__main__":
    main()
