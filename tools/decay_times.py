"""How long our materials ring, beside measured ones of the same kind.

    pip download --no-deps --no-binary=:all: tdw==1.13.0.0 && tar xzf tdw-1.13.0.0.tar.gz
    python tools/decay_times.py --tdw=tdw-1.13.0.0

writes `results/decay_times.csv` and prints the table of docs/explanation/sound.md.
Without `--tdw` it only prints.

Measured are the modes of struck objects, of which PyImpact plays the first ten of each (Traer, Cusimano and McDermott, "A
perceptually inspired generative model of rigid-body contact sounds", DAFx 2019). They are in the package `tdw`, Copyright 2020
Massachusetts Institute of Technology, under the 2-clause BSD licence. Objects that the package holds twice count once.
"""

import argparse
import csv
import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_playbyear.sound.materials import MATERIALS
from gym_playbyear.sound.synthesizer import DAMPING_OCTAVES

TABLE = Path(__file__).parents[1] / "results/decay_times.csv"
_SOURCE = "tdw 1.13.0.0, tdw/add_ons/py_impact/material_data (PyPI; Copyright 2020 MIT; BSD-2-Clause)"
_PLAYED = 10  # modes of an object that PyImpact plays: the first
KINDS = {
    "gripper": "metal", "wall": "metal", "tin": "metal", "screws": "metal", "keys": "metal",
    "cube": "plastic_hard", "tray": "plastic_hard", "bottle": "plastic_hard", "pens": "plastic_hard", "candies": "plastic_hard",
    "table": "wood_medium", "glass": "glass", "cardboard": "cardboard", "rubber": "rubber",
    "peanuts": "plastic_soft_foam", "sponge": "plastic_soft_foam", "cloth": "fabric",
    "pouch": "paper", "bag": "paper", "chips": "paper",  # nobody measured film: the nearest thin sheet
}  # fmt: skip
"""The measured kind of each of our materials."""


class Measured(NamedTuple):
    """objects, modes: how many. p10, median, p90: of their times to fall by 60 dB [ms]."""

    kind: str
    objects: int
    modes: int
    p10: float
    median: float
    p90: float
    source: str = _SOURCE


def decay_times(material: str) -> tuple[float, float, float]:
    """Time in which the median mode of ours falls by 60 dB [ms]: the shortest of all episodes, the middle one, the longest."""
    middle = 1000.0 * float(np.median(np.log(1000.0) / np.array(MATERIALS[material].decays)))
    return middle / 2.0**DAMPING_OCTAVES, middle, middle * 2.0**DAMPING_OCTAVES


def measured() -> dict[str, Measured]:
    """The committed table, by kind."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["kind"]: Measured(
            row["kind"],
            int(row["objects"]),
            int(row["modes"]),
            *(float(row[name]) for name in ("p10", "median", "p90")),
        )
        for row in rows
    }


class Modes(NamedTuple):
    """Of one object: pitches [Hz], levels [dB], times to fall by 60 dB [s]."""

    pitches: tuple[float, ...]
    levels: tuple[float, ...]
    times: tuple[float, ...]


def objects(tdw: Path) -> dict[str, list[Modes]]:
    """The different objects of each kind, from the package's files.

    Raises:
        FileNotFoundError: The package's files are not in `tdw`.
    """
    found: dict[str, list[Modes]] = {}
    for path in sorted(tdw.glob("tdw/add_ons/py_impact/material_data/*_mm.json")):
        kind = re.sub(r"_\d_mm$", "", path.stem)
        if kind in ("Ceramic", "plastc_hard"):
            continue  # misspelt: PyImpact never loads them
        read = json.loads(path.read_text())
        modes = Modes(*(tuple(read[name][:_PLAYED]) for name in ("cf", "op", "rt")))
        if modes not in found.setdefault(kind, []):
            found[kind].append(modes)
    if not found:
        raise FileNotFoundError(f"--tdw={tdw}: no tdw/add_ons/py_impact/material_data/*_mm.json is in it; see --help.")
    return found


def measure(tdw: Path) -> list[Measured]:
    """The table, from the package's files."""
    rows = []
    for kind, different in objects(tdw).items():
        times = 1000.0 * np.concatenate([modes.times for modes in different])
        quantiles = (round(float(np.percentile(times, share)), 1) for share in (10, 50, 90))
        rows.append(Measured(kind, len(different), len(times), *quantiles))
    return rows


def page() -> str:
    """The table of docs/explanation/sound.md."""
    lines = ["| kind | measured [ms] | ours [ms] |", "|---|---|---|"]
    for kind, row in measured().items():
        names = [name for name, each in KINDS.items() if each == kind]
        if names:
            own = ", ".join(f"{name} {decay_times(name)[1]:.0f}" for name in names)
            lines.append(f"| {kind.replace('_', ' ')} | {row.median:.0f} ({row.p10:.0f} to {row.p90:.0f}) | {own} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tdw", type=Path, help="folder into which the package was unpacked")
    options = parser.parse_args()
    if options.tdw:
        TABLE.parent.mkdir(parents=True, exist_ok=True)
        with TABLE.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(Measured._fields)
            writer.writerows(measure(options.tdw))
    print(page())


if __name__ == "__main__":
    main()
