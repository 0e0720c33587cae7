"""The results as tables in Markdown: `python -m experiments.report`.

With `--write` they replace those in `docs/learning_log.md`; `tests/test_figures.py` says where the two differ.
"""

import argparse
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

from experiments.corrections import load_corrections
from experiments.interactive import STUDY as INTERACTIVE
from experiments.others import STUDY as OTHERS
from experiments.others import OtherResult
from experiments.protocol import (
    ATTEMPT_STEPS,
    CONDITIONS,
    NEW_TASKS,
    RESULTS,
    RUN_LENGTHS,
    STEPS,
    TASKS,
    Result,
    blind_path,
    load,
    load_demonstrations,
    load_results,
    wilson_interval,
)

LOG = Path(__file__).parents[1] / "docs/learning_log.md"
BEGIN, END = "<!-- results: begin -->\n", "<!-- results: end -->"


def table(head: str, rows: list[str], title: str = "") -> list[str]:
    """A table without blanks beside its bars, with a heading or without; nothing where there are no rows."""
    if not rows:
        return []
    heading = [f"### {title}", ""] if title else []
    lines = [head, "|---" * (head.count("|") - 1) + "|", *rows]
    return [*heading, *(re.sub(r" *\| *", "|", line) for line in lines), ""]


def interval(n_successes: int, n: int) -> str:
    low, high = wilson_interval(n_successes, n)
    return f"({100 * low:.0f} to {100 * high:.0f})"


def percent(results: list[Result]) -> str:
    """Rate over all episodes of some policies, with its 95 % interval, and the rate of each policy."""
    successes = [success for result in results for success in result.successes]
    n_successes, n = sum(successes), len(successes)
    each = ", ".join(f"{100 * result.rate:.0f}" for result in results)
    return f"**{100 * n_successes / n:.0f} %** {interval(n_successes, n)} | {each}"


def acted_early(results: list[Result]) -> str:
    """In what share of the episodes of each policy the hand acted before anything was heard; empty where nobody looked."""
    return ", ".join("" if result.early_rate is None else f"{result.early_rate:.0%}" for result in results).strip(", ")


def ablation_table(task: str) -> list[str]:
    rows = []
    found = [(condition, load_results(f"ablations/{task}-{condition}-*.json")) for condition in CONDITIONS]
    for name, variant in EARLIER_PRESETS.items():
        for condition in ("full", "deaf"):
            results = load_results(f"presets/{task}-{condition}-{variant}-*.json")
            found.append((f"{condition}: {name}", results))
    for condition, trained in found:
        for steps in sorted({result.steps for result in trained}):
            results = [result for result in trained if result.steps == steps]
            policy = condition + _updates(results)
            minutes = ", ".join(f"{result.minutes:.0f}" for result in results)
            failures = "; ".join(result.failures for result in results) if any(r.ends for r in results) else ""
            if told := "; ".join(filter(None, (result.by_contents for result in results))):
                policy += f" ({told})"
            rows.append(f"| {policy} | {percent(results)} | {acted_early(results)} | {failures} | {minutes} |")
    if blind_path(task).exists():
        blind = load(blind_path(task))
        first, last = blind["seeds"]
        n = last - first + 1
        rates = blind["success"]
        expert = rates.pop("expert")
        name, best = max(rates.items(), key=lambda item: item[1])
        rows.append(f"| best blind script (`{name}`) | **{best:.0%}** {interval(round(n * best), n)} | | | | |")
        rows.append(f"| expert that feels contact | {expert:.0%} | | | | |")
    head = "| policy | success (95 % interval) | training seeds | acted early | failures | minutes of training |"
    return table(head, rows, task)


def _updates(results: list[Result]) -> str:
    """How many updates were made, the same in all results, where they are not the preset's."""
    steps = results[0].steps
    return "" if steps == STEPS or results[0].task in TASKS else f", {steps} updates"


EARLIER_PRESETS = {
    "noise up to 18 dB": "quieter_noise",
    "and larger shifts and offset": "larger_shifts",
    "and ways told however far": "far_way",
    "and no `auxiliary_way`": "no_way",
    "and twice the noise on the arm": "twice_the_noise",
    "and twice the noise on the arm, action range 1": "action_range_1_twice_the_noise",
    "and no readers, no envelope": "no_readers_no_envelope",
    "and no readers, no envelope, an expert whose hops do not miss": "no_readers_no_envelope_plain_expert",
    "and an expert whose hops miss and are mended": "missing_hops",
    "and no envelope, an expert that hops more slowly": "no_envelope_slower_expert",
    "and envelope times 3": "envelope",
    "and steps of 35 ms": "hop_35ms",
    "and no `auxiliary_onset`": "no_onset",
}
"""The latest first, by the names of their files."""
CURVES = {
    "noise": "noise",
    "noise-quieter_noise": "noise, trained with up to 18 dB",
    "noise-recorded_noise": "noise, trained with recordings too, 4,000 updates",
    "noise-no_noise": "noise, trained without noise in the sound",
    "noise_white": "noise, trained with white noise up to the recordings' own floor",
    "materials": "materials",
    "rooms": "kinds of noise and microphones that no training had",
    "rooms-recorded_noise": "the same, trained with recordings of other kinds, 4,000 updates",
}


def curve_table(study: str, task: str) -> list[str]:
    by_value: dict[str, list[Result]] = defaultdict(list)
    for result in load_results(f"{study}/{task}-*.json"):
        by_value[_condition(result.environment)].append(result)
    rows = [f"| {value} | {percent(results)} |" for value, results in sorted(by_value.items(), key=_order)]
    head = f"| {study.replace('-', '_').split('_')[0]} | success (95 % interval) | training seeds |"
    return table(head, rows, f"{task}: {CURVES[study]}")


def _condition(environment: dict[str, str]) -> str:
    """One option of the environment as its value, several with what they are."""
    values = {name: Path(value).stem if "/" in value else value for name, value in environment.items()}
    if len(values) == 1:
        return next(iter(values.values()))
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items())


def sightless_table() -> list[str]:
    """What scripts solve that do not see, beside the policies without pictures."""
    rows = []
    for path in sorted((RESULTS / "sightless").glob("*.json")):
        report = load(path)
        solved = {script: ends.count("success") for script, ends in report["ends"].items()}
        n = len(report["ends"]["guess"])
        cells = [f"{solved[script] / n:.0%} {interval(solved[script], n)}" for script in ("guess", "everywhere")]
        policies = load_results(f"ablations/{report['task']}-sightless-*.json")
        rows.append(f"| {report['task']} | {' | '.join(cells)} | {percent(policies) if policies else ' | '} |")
    head = "| task | script, guesses | script, searches everywhere | sightless policies | training seeds |"
    return table(head, rows, "Without pictures")


def demonstration_table(task: str) -> list[str]:
    results, rows = load_demonstrations(task), []
    for n in sorted({result.n_demonstrations for result in results}):
        found = [
            [r for r in results if (r.n_demonstrations, r.condition) == (n, condition)]
            for condition in ("full", "deaf")
        ]
        rows.append(f"| {n} | {' | '.join(percent(of) if of else ' | ' for of in found)} |")
    head = "| demonstrations | full | training seeds | deaf | training seeds |"
    quieter = any((RESULTS / "demonstrations-quieter_noise").glob(f"{task}-*.json"))
    noise = ", full policies trained with up to 18 dB" if quieter else ""
    return table(head, rows, f"{task}: demonstrations{noise}")


def listening_table() -> list[str]:
    rows = []
    for path in sorted((RESULTS / "listening").glob("*.json")):
        report = load(path)
        cells = [f"{report[mode]['n_reacted']} of {report[mode]['n_trials']}" for mode in ("false", "control", "muted")]
        closed = f"{report['false']['n_closed_there']} of {report['false']['n_trials']}"
        rows.append(f"| {path.stem} | {' | '.join(cells)} | {closed} |")
    head = "| policy | false contact | nothing swapped | muted contact | closed at the false contact |"
    return table(head, rows, "Listening")


def correction_tables(task: str) -> list[str]:
    """What corrections are worth, in the time of the attempts and in the task's own, and where the time of a round goes."""
    kinds = load_corrections(task)
    rows = []
    for kind, results in kinds.items():
        policy = " | ".join(map(str, kind))
        updates = ", ".join(str(result.updates) for result in results)
        minutes = ", ".join(f"{result.minutes['dagger']:.0f}" for result in results)
        for time, key in (("the task's own", "in_task_time"), (f"{ATTEMPT_STEPS[task]} steps", "success")):
            first, last = ([result.evaluations[n][key] for result in results] for n in (0, -1))
            rates = [first, last, [result.control[key] for result in results]]
            cells = " | ".join(_mean_of_seeds(values) for values in rates)
            rows.append(f"| {policy} | {time} | {cells} | {updates} | {minutes} |")
    names = sorted({name for results in kinds.values() for result in results for name in result.seconds} - {"total_s"})
    shares = []
    for (condition, _, steps), results in kinds.items():
        total = sum(result.seconds["total_s"] for result in results)
        spent = [sum(result.seconds.get(name, 0.0) for result in results) for name in names]
        cells = " | ".join(f"{value / total:.1%}" for value in spent)
        shares.append(f"| {condition}, {steps} updates before | {cells} | {total:.0f} s |")
    head = "| policy | demonstrations | updates | time | before | corrected | control | more updates | minutes |"
    share_head = f"| share of a round | {' | '.join(name.removesuffix('_s') for name in names)} | all of it |"
    return table(head, rows, f"{task}: corrections") + table(share_head, shares)


def _mean_of_seeds(rates: list[float]) -> str:
    """The mean, and in brackets the rate of each training seed."""
    mean = f"**{sum(rates) / len(rates):.0f} %**"
    return mean if len(rates) == 1 else f"{mean} ({', '.join(f'{rate:.0f}' for rate in rates)})"


def interactive_tables(task: str) -> list[str]:
    """Methods of correction: success before and after each round, what the expert spent, and what controls bring."""
    groups: dict[str, list[str]] = defaultdict(list)
    for path in sorted((RESULTS / INTERACTIVE).glob(f"{task}-*.json")):
        study = load(path)
        first, *rounds = study["outcomes"]
        controls = (_control(name, control, first) for name, control in study["controls"].items())
        cells = (
            *(study["method"], study["training_seed"], _of_each(study["outcomes"], "success", ".0f")),
            *(_of_each(rounds, name, form) for name, form in _SPENT.items()),
            "; ".join(filter(None, [_contents(first), _contents(rounds[-1]), rounds[-1]["failures"]])),
            "; ".join(filter(None, controls)),
        )
        options = "".join(f", `{option}`" for option in study["training_options"])
        title = f"{task}: corrections of policies of {first['n_demonstrations']} demonstrations{options}"
        groups[title].append(f"| {' | '.join(map(str, cells))} |")
    names = " | ".join(name.replace("_", " ") for name in _SPENT)
    head = f"| `--method` | seed | success | {names} | failures | instead |"
    return [line for title, rows in groups.items() for line in table(head, rows, title)]


_SPENT = {
    "updates": ",",
    "kept": "",
    "attempts": "",
    "expert_steps": ",",
    "switches": "",
    "autonomy": ".0%",
    "person_seconds": ",.0f",
}
"""What each round took, and how it is written."""


def _of_each(outcomes: list[dict[str, Any]], name: str, form: str) -> str:
    """A figure of each outcome; empty where nobody counted."""
    figures = [outcome.get(name, 0) for outcome in outcomes]
    return "; ".join(f"{figure:{form}}" for figure in figures) if any(figures) else ""


def _contents(outcome: dict[str, Any]) -> str:
    return str(outcome.get("by_contents", ""))


def _control(name: str, control: dict[str, Any], first: dict[str, Any]) -> str:
    """What as many updates, or as many of the expert's steps in further demonstrations, brought; empty if it is the first."""
    further = control["n_demonstrations"] - first["n_demonstrations"]
    if not further and control["updates"] == first["updates"]:
        return ""
    what = f"{further} further demonstrations ({control['expert_steps']:,} steps)" if further else "none"
    return f"{what}, {control['updates']:,} updates: {control['success']:.0f}"


def run_length_table(task: str) -> list[str]:
    """What windows that share encodings teach, beside windows that do not: as many of them, and what they took."""
    rows = []
    for length in RUN_LENGTHS:
        results = load_results(f"run_length/{task}-full-k{length}-*.json")
        if results:
            paths = (RESULTS / "run_length" / "held_out_loss").glob(f"{task}-full-k{length}-*.json")
            losses = ", ".join(f"{load(path):.4f}" for path in sorted(paths))
            minutes = ", ".join(f"{result.minutes:.1f}" for result in results)
            rows.append(f"| {length} | {percent(results)} | {losses} | {minutes} |")
    head = "| K | success (95 % interval) | training seeds | held-out loss | minutes |"
    return table(head, rows, f"{task}: windows per run, K")


def others_table(task: str) -> list[str]:
    """LeRobot's own policies on the same demonstrations."""
    found: dict[tuple[str, str, float], list[OtherResult]] = defaultdict(list)
    for path in sorted((RESULTS / OTHERS).glob(f"{task}-*min-seed*.json")):
        condition, setting, *_ = path.stem.removeprefix(f"{task}-").split("-")
        result = OtherResult(**load(path))
        found[setting, condition, result.budget_minutes].append(result)
    rows = []
    for (setting, condition, budget), results in sorted(found.items()):
        updates, minutes, ms = (
            ", ".join(f"{getattr(result, name):,.{digits}f}" for result in results)
            for name, digits in (("steps", 0), ("minutes", 0), ("ms_per_step", 1))
        )
        failures = "; ".join(result.failures for result in results)
        cells = (setting, condition, f"{budget:g}", percent(results), failures, updates, minutes, ms)
        rows.append(f"| {' | '.join(cells)} |")
    head = (
        "| policy | sound | minutes | success (95 % interval) | training seeds | failures | updates | minutes that it took | "
        "ms per step |"
    )
    return table(head, rows, f"{task}: LeRobot's own policies")


def _order(item: tuple[str, list[Result]]) -> tuple[float, str]:
    try:
        return float(item[0]), ""
    except ValueError:
        return 0.0, item[0]


def report() -> str:
    """All tables, in one text."""
    tasks = NEW_TASKS + TASKS
    lines = [line for task in tasks for line in ablation_table(task)] + sightless_table() + listening_table()
    for task in tasks:
        lines += demonstration_table(task)
        for study in CURVES:
            lines += curve_table(study, task)
        lines += others_table(task) + run_length_table(task) + correction_tables(task) + interactive_tables(task)
    return "\n".join(lines)


def in_log() -> str:
    """The tables as the log has them."""
    return LOG.read_text().partition(BEGIN)[2].partition(END)[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help=f"into {LOG.name} instead of to the terminal")
    tables = report()
    if parser.parse_args().write:
        before, begin, rest = LOG.read_text().partition(BEGIN)
        LOG.write_text(before + begin + tables + END + rest.partition(END)[2])
    else:
        print(tables)


if __name__ == "__main__":
    main()
