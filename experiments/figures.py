"""The results as pictures: `python -m experiments.figures --output=docs/media`."""

from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from experiments.corrections import load_corrections
from experiments.protocol import (
    NEW_TASKS,
    TASKS,
    blind_path,
    command_line,
    load,
    load_demonstrations,
    load_results,
    wilson_interval,
)

COLOURS = {"full": "#1f6f8b", "deaf": "#c8553d", "blind": "#777777"}
NOISES = {
    "noise": ("the preset: a room's noise in training", COLOURS["full"]),
    "noise-quieter_noise": ("up to 18 dB above the floor, not 24", "#2e8b57"),
    "noise-recorded_noise": ("the preset's, and recordings; 4,000 updates", "#7b5ea7"),
    "noise_white": ("white noise in training, up to the floor", "#d08c2e"),
}
KINDS = ("#1f6f8b", "#d08c2e", "#7b5ea7", "#c8553d")  # of corrected policies: as they come


def band(axes: Axes, points: dict[float, list[bool]], label: str, colour: str) -> None:
    """A line of success rates over some quantity, with 95 % intervals."""
    xs = sorted(points)
    rates = [100 * sum(points[x]) / len(points[x]) for x in xs]
    intervals = [wilson_interval(sum(points[x]), len(points[x])) for x in xs]
    axes.plot(xs, rates, marker="o", color=colour, label=label)
    axes.fill_between(
        xs, [100 * low for low, _ in intervals], [100 * high for _, high in intervals], color=colour, alpha=0.15
    )


def blind_line(axes: Axes, task: str) -> None:
    if blind_path(task).exists():
        rates = load(blind_path(task))["success"]
        best = max(rate for name, rate in rates.items() if name != "expert")
        axes.axhline(100 * best, color=COLOURS["blind"], linestyle="--", label="best blind script")


def demonstrations(task: str, output: Path) -> None:
    """Success of the full and the deaf policy over the number of demonstrations."""
    results = load_demonstrations(task)
    if not results:
        return
    axes = new_axes()
    for condition in ("full", "deaf"):
        points: dict[float, list[bool]] = {}
        for result in results:
            if result.condition == condition:
                points.setdefault(result.n_demonstrations, []).extend(result.successes)
        if points:
            band(axes, points, condition, COLOURS[condition])
    blind_line(axes, task)
    axes.set_xscale("log")
    ticks = sorted({r.n_demonstrations for r in results})
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    finish(axes, "demonstrations", output / f"demonstrations-{task}.png")


def noise(task: str, output: Path) -> None:
    """Success of the full policies over the background's level, with each recipe's noise in training."""
    curves: dict[str, dict[float, dict[int, list[bool]]]] = {}
    for study in NOISES:
        for result in load_results(f"{study}/{task}-*.json"):
            level = float(result.environment["noise_level"])
            curves.setdefault(study, {}).setdefault(level, {})[result.training_seed] = result.successes
    if not curves:
        return
    axes = new_axes()
    for study, by_level in curves.items():
        label, colour = NOISES[study]
        seeds = set.intersection(
            *map(set, by_level.values())
        )  # what only some levels were tried with would bend the line
        points = {level: [*chain.from_iterable(tried[seed] for seed in seeds)] for level, tried in by_level.items()}
        band(axes, points, f"{label} ({len(seeds)} training seed{'s' if len(seeds) > 1 else ''})", colour)
    blind_line(axes, task)
    axes.set_xscale("symlog", base=2, linthresh=1)  # 0 is silence
    levels = sorted({level for by_level in curves.values() for level in by_level})
    axes.set_xticks(levels, [f"{level:g}" for level in levels])
    axes.minorticks_off()
    axes.set_xlim(-0.2 if levels[0] == 0 else 0.9, 1.1 * levels[-1])
    above = {"loc": "lower left", "bbox_to_anchor": (0, 1), "fontsize": "small"}
    finish(axes, "background noise (0: silence, 1: as in training)", output / f"noise-{task}.png", **above)


def corrections(task: str, output: Path) -> None:
    """Success over the attempts that were corrected, with the control beside it: each training seed, and their mean."""
    kinds = load_corrections(task)
    if not kinds:
        return
    axes = new_axes()
    for colour, (kind, results) in zip(KINDS, kinds.items(), strict=False):
        curves = [{point["kept"]: point["success"] for point in result.evaluations} for result in results]
        controls = [result.control["success"] for result in results]
        for curve in curves:
            axes.plot(list(curve), list(curve.values()), color=colour, linewidth=0.8, alpha=0.5)
        kept = sorted(set.intersection(*map(set, curves)))
        means = [sum(curve[k] for curve in curves) / len(curves) for k in kept]
        condition, n_demonstrations, steps = kind
        seeds = f"{len(results)} training seed{'s' * (len(results) > 1)}"
        label = f"{condition}: {n_demonstrations} demonstrations, {steps:,} updates ({seeds})"
        axes.plot(kept, means, marker="o", color=colour, label=label)
        axes.plot([kept[-1]] * len(controls), controls, marker="x", color=colour, linestyle="", alpha=0.5)
        axes.plot(kept[-1], sum(controls) / len(controls), marker="X", markersize=9, color=colour)
    axes.plot([], [], marker="X", color="black", linestyle="", label="as many updates on the demonstrations")
    path = output / f"corrections-{task}.png"
    finish(axes, "attempts with corrections", path, loc="upper center", bbox_to_anchor=(0.5, -0.16))


def new_axes() -> Axes:
    """Of a new figure, success from 0 to 100 %."""
    _, axes = plt.subplots(figsize=(6, 3.6))
    axes.set(ylabel="success [%]", ylim=(0, 100))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def finish(axes: Axes, label: str, path: Path, **legend: Any) -> None:
    """Label, legend, file."""
    axes.set_xlabel(label)
    axes.legend(frameon=False, **legend)
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
    print(path)


def main() -> None:
    output = command_line(__doc__, "output").parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    for draw in (demonstrations, noise, corrections):
        for task in NEW_TASKS + TASKS:
            draw(task, output)


if __name__ == "__main__":
    main()
