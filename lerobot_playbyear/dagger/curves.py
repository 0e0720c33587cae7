"""Curves of runs of interactive imitation: success over what the expert spent, and how much it was needed.

python -m lerobot_playbyear.dagger.curves outputs/hg outputs/thrifty --output=curves.png
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_playbyear.dagger.figures import Totals, steps_until
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.hub.push import METRICS_NAME, figures_in

Lines = Sequence[Mapping[str, Any]]
Curve = tuple[list[float], list[float]]


def read_lines(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's `metrics.jsonl`.

    Raises:
        InputError: There is none.
    """
    path = Path(folder) / METRICS_NAME
    if not path.is_file():
        raise InputError(f"{folder}: there is no {METRICS_NAME}; give the output folder of a run of playbyear-dagger.")
    return [line for text in path.read_text().splitlines() if (line := figures_in(text))]


def curves_of(lines: Lines) -> dict[str, Curve]:
    """What is drawn of a run, each as places along the horizontal axis and values.

    Returns:
        `success` of evaluations [%] over the expert's steps; `autonomy` of the rounds, `takeover_steps` (their mean length) and
        `switches` so far over the rounds; `person_minutes` so far over the rounds.
    """
    evaluations = [line for line in lines if line.get("kind") == "eval" and "expert_steps" in line]
    rounds = [line for line in lines if line.get("kind") == "round" and "expert_steps" in line]
    numbers = [float(line["round"]) for line in rounds]
    return {
        "success": ([float(e["expert_steps"]) for e in evaluations], [float(e["pc_success"]) for e in evaluations]),
        "autonomy": (numbers, [100 * float(line["autonomy"]) for line in rounds]),
        "takeover_steps": (numbers, [float(line["mean_takeover_steps"]) for line in rounds]),
        "switches": (numbers, [float(line["switches"]) for line in rounds]),
        "person_minutes": (numbers, [float(line["person_seconds"]) / 60 for line in rounds]),
    }


_PANELS = {
    "success": ("Steps of the expert", "Success [%]"),
    "autonomy": ("Round", "Steps of the policy [%]"),
    "takeover_steps": ("Round", "Mean length of a takeover [steps]"),
    "switches": ("Round", "Context switches so far"),
    "person_minutes": ("Round", "A person's time so far [min]"),
}


def draw_curves(runs: Mapping[str, Lines], path: Path) -> None:
    """Draws the curves of several runs into one picture, a panel for each figure.

    Args:
        runs: The lines of each run's `metrics.jsonl`, by the name that it shall have in the legend.
        path: The picture; its ending says of which format.

    Raises:
        InputError: matplotlib is not installed, or the picture cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("Curves are drawn by matplotlib: pip install matplotlib.") from error
    figure = Figure(figsize=(4.2 * len(_PANELS), 3.6), layout="constrained")
    panels = figure.subplots(1, len(_PANELS))
    for name, lines in runs.items():
        for axes, (kind, curve) in zip(panels, curves_of(lines).items(), strict=True):
            axes.plot(*curve, marker=".", label=name)
            axes.set(xlabel=_PANELS[kind][0], ylabel=_PANELS[kind][1])
    panels[0].set_ylim(0, 100)
    panels[1].set_ylim(0, 100)
    panels[0].legend()
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--output={path} cannot be written: {error}. Give a folder that is there, and an ending such as .png."
        ) from error


def table_of(runs: Mapping[str, Lines]) -> str:
    """The runs' figures in the end, as a table in Markdown."""
    header = ("run", "success [%]", "expert steps", "until 80 %", "until 90 %", "takeovers", "their length [steps]")
    rows: list[tuple[str, ...]] = [(*header, "switches", "autonomy [%]", "a person's time [min]")]
    for name, lines in runs.items():
        totals, evaluated = Totals.of(lines), [line["pc_success"] for line in lines if line.get("kind") == "eval"]
        until = (steps_until(lines, 80), steps_until(lines, 90))
        rows.append(
            (
                name,
                f"{evaluated[-1]:.0f}" if evaluated else "-",
                str(totals.expert_steps),
                *("-" if steps is None else str(steps) for steps in until),
                str(totals.takeovers),
                f"{totals.mean_takeover_steps:.0f}",
                str(totals.switches),
                f"{100 * totals.autonomy:.0f}",
                f"{totals.person_seconds / 60:.1f}",
            )
        )
    rows.insert(1, ("---",) * len(rows[0]))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folders", nargs="+", type=Path, help="output folders of playbyear-dagger")
    options.add_argument("--output", type=Path, default=None, help="picture of the curves")
    given = options.parse_args()
    try:
        runs = {str(folder): read_lines(folder) for folder in given.folders}
        print(table_of(runs))
        if given.output is not None:
            draw_curves(runs, given.output)
            print(f"\nCurves: {given.output}")
    except InputError as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
