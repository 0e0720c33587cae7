"""`playbyear-reproduce` with the commands themselves, tiny: twice the same figure, the same typed by hand, and all of it."""

import shlex
from pathlib import Path

import pytest

from lerobot_playbyear.reproduce.table import Table, told

pytestmark = pytest.mark.slow
ONLY = "--only=interventions/OccludedGrasp-v1/full/seed=1"


def options(folder: Path) -> list[str]:
    return ["--size=smoke", f"--output_dir={folder / 'out'}", f"--results={folder / 'results'}"]


def figures(folder: Path) -> dict[str, object]:
    (row,) = Table(folder / "results").rows()
    return {name: row[name] for name in ("successes", "failures", "ends", "curve", "best")}


def test_a_cell_gives_the_same_figure_twice_also_where_it_was_killed(commands, tmp_path):
    once, again = tmp_path / "once", tmp_path / "again"
    commands.succeed("playbyear-reproduce", "run", ONLY, *options(once))
    for name in ("train", "dagger", "cells"):  # killed when the first step of each kind has begun
        begun = again / "out/smoke" / name
        commands.run("playbyear-reproduce", "run", ONLY, *options(again), kill_when=begun.exists)
    commands.succeed("playbyear-reproduce", "run", ONLY, *options(again))
    assert figures(once) == figures(again)


def test_the_commands_of_a_cell_do_the_same_typed_by_hand(commands, tmp_path):
    cell, hand = tmp_path / "cell", tmp_path / "hand"
    commands.succeed("playbyear-reproduce", "run", ONLY, *options(cell))
    (row,) = Table(cell / "results").rows()
    for line in row["commands"]:
        commands.succeed(*shlex.split(line.replace(str(cell), str(hand))))
    attempts = sorted((hand / "out").rglob("held_out-*-last/attempts.jsonl"))
    assert told(attempts[0], 70000, len(row["successes"]))["successes"] == row["successes"]
    weights = (
        "out/smoke/dagger/OccludedGrasp-v1-2-full-hg_dagger-seed1/checkpoints/last/pretrained_model/model.safetensors"
    )
    assert (cell / weights).read_bytes() == (hand / weights).read_bytes()


def test_the_whole_matrix_tiny_fills_every_section_of_the_report(commands, tmp_path):
    """A quarter of an hour on two cores that nothing else uses."""
    commands.succeed("playbyear-reproduce", "run", "--jobs=2", *options(tmp_path))
    commands.succeed("playbyear-reproduce", "report", *options(tmp_path))
    text = (tmp_path / "out/smoke/report.md").read_text()
    assert "not run" not in text
    assert "no contact" in text or "false grasp" in text
    page = (tmp_path / "out/smoke/report.html").read_text()
    assert page.count("<video") > 5
    assert page.count("<polyline") > 5
