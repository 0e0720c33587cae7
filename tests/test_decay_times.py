"""Our materials ring as long as measured objects of the same kind: the table of `tools/decay_times.py`."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from gym_playbyear.sound.materials import MATERIALS

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

from decay_times import KINDS, decay_times, measure, measured, page
from sound_scenes import box_on_table, listen


@pytest.mark.parametrize("material", MATERIALS)
def test_a_material_rings_within_the_measured_range_of_its_kind_in_every_episode(material):
    kind = measured()[KINDS[material]]
    shortest, _, longest = decay_times(material)
    assert kind.p10 <= shortest < longest <= kind.p90


@pytest.mark.parametrize("material", ["rubber", "candies"])
def test_what_is_heard_falls_silent_as_fast_as_the_table_says(material):
    """From the samples of a blow: the slope of the energy that is still to come, from 5 to 25 dB below all of it."""
    scene = box_on_table((material, "cloth"), speed=0.4)  # cloth is nearly mute
    contacts, times = scene.contacts(0.3), []
    for seed in range(12):
        wave = listen(scene, contacts, scene.synth(48000, randomise=True), seed)["table"].astype(float)
        left = np.cumsum(wave[::-1] ** 2)[::-1]
        level = 10 * np.log10(left / left[0] + 1e-12)
        fits = (level < -5) & (level > -25)
        slope = np.polyfit(np.flatnonzero(fits) / 48000, level[fits], 1)[0]
        times.append(1000 * 60 / -slope)
    assert np.median(times) == pytest.approx(decay_times(material)[1], rel=0.15)


def test_the_page_on_sound_has_the_table():
    shown = (Path(__file__).parents[1] / "docs/explanation/sound.md").read_text()
    assert page() in re.sub(r"\[([^]]*)\]\(\.\./media/materials/\w+\.flac\)", r"\1", shown)


def test_the_table_counts_each_object_once_and_what_pyimpact_plays(tmp_path):
    folder = tmp_path / "tdw/add_ons/py_impact/material_data"
    folder.mkdir(parents=True)
    objects = {
        "metal_0": [0.1] * 5 + [0.3] * 5 + [9.0],
        "metal_1": [0.2] * 10,
        "metal_2": [0.2] * 10,
        "Ceramic_3": [9.0],
    }
    for name, times in objects.items():
        (folder / f"{name}_mm.json").write_text(
            json.dumps({"cf": [440.0] * len(times), "op": [-30.0] * len(times), "rt": times})
        )
    assert [row[:6] for row in measure(tmp_path)] == [("metal", 2, 20, 100.0, 200.0, 300.0)]
    with pytest.raises(FileNotFoundError, match="--tdw="):
        measure(tmp_path / "elsewhere")
