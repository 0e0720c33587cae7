"""The results as tables in Markdown: `python -m experiments.report`."""

import json
from collections import defaultdict

from experiments.corrections import Corrected, load_corrections
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


CURVES = {
    "noise": "noise",
    "noise_white": "noise, trained with white noise up to the recordings' own floor",
    "materials": "materials",
}


def curve_table(study: str, task: str) -> list[str]:
    by_value: dict[str, list[Result]] = defaultdict(list)
    for result in load_results(f"{study}/{task}-*.json"):
        by_value[", ".join(result.environment.values())].append(result)
    if not by_value:
        return []
    lines = [
        f"### {task}: {CURVES[study]}",
        "",
        f"| {study.split('_')[0]} | success (95 % interval) | training seeds |",
        "|---|---|---|",
    ]
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


def correction_table(task: str) -> list[str]:
    """What corrections are worth, in the time of the attempts and in the task's own, and where the time of a round goes."""
    kinds: dict[tuple[str, int, int], list[Corrected]] = defaultdict(list)
    for result in load_corrections(task):
        kinds[result.kind].append(result)
    if not kinds:
        return []
    lines = [f"### {task}: corrections", ""]
    lines.append("| policy | demonstrations | updates | time | before | corrected | control | more updates | minutes |")
    lines.append("|---|---|---|---|---|---|---|---|---|")
    for kind, results in kinds.items():
        policy = " | ".join(map(str, kind))
        updates = ", ".join(str(result.updates) for result in results)
        minutes = ", ".join(f"{result.minutes['dagger']:.0f}" for result in results)
        for time, key in (("the task's own", "in_task_time"), (f"{ATTEMPT_STEPS[task]} steps", "success")):
            first, last = ([result.evaluations[n][key] for result in results] for n in (0, -1))
            rates = [first, last, [result.control[key] for result in results]]
            cells = " | ".join(_mean_of_seeds(values) for values in rates)
            lines.append(f"| {policy} | {time} | {cells} | {updates} | {minutes} |")
    names = sorted({name for results in kinds.values() for result in results for name in result.seconds} - {"total_s"})
    lines += ["", f"| share of a round | {' | '.join(name.removesuffix('_s') for name in names)} | all of it |"]
    lines.append("|---" * (len(names) + 2) + "|")
    for (condition, _, steps), results in kinds.items():
        total = sum(result.seconds["total_s"] for result in results)
        spent = [sum(result.seconds.get(name, 0.0) for result in results) for name in names]
        cells = " | ".join(f"{value / total:.1%}" for value in spent)
        lines.append(f"| {condition}, {steps} updates before | {cells} | {total:.0f} s |")
    return [*lines, ""]


def _mean_of_seeds(rates: list[float]) -> str:
    """The mean, and in brackets the rate of each training seed."""
    mean = f"**{sum(rates) / len(rates):.0f} %**"
    return mean if len(rates) == 1 else f"{mean} ({', '.join(f'{rate:.0f}' for rate in rates)})"


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
        lines += curve_table("noise", task) + curve_table("noise_white", task) + curve_table("materials", task)
        lines += run_length_table(task)
        lines += correction_table(task)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
