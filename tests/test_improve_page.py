"""The tutorial on a policy of about 60 %: its commands as they stand there, made small by other numbers."""

import json
import shutil
from itertools import takewhile
from pathlib import Path

import pytest
from support.pages import ROOT, commands_of

PAGE = ROOT / "docs/tutorials/improve.md"
SMALL = {"--steps": 2, "--dataset.num_episodes": 2, "--eval.n_episodes": 1, "--eval.batch_size": 1}


def small_commands() -> list[list[str]]:
    """Those of the page; a preset's updates and the episodes that are collected are few, too."""
    found = commands_of(PAGE, SMALL)
    for words in found:
        if "--preset=cpu" in words and "--steps=2" not in words:
            words.append("--steps=2")
        words[:] = ["--num_episodes=1" if word == "--num_episodes=50" else word for word in words]
    return found


@pytest.mark.slow
def test_the_steps_in_simulation_are_run_as_they_stand(commands, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in takewhile(lambda words: words[0] != "lerobot-record", small_commands()):
        if words[0] == "cp":
            shutil.copytree(*words[2:])
        else:
            commands.succeed(*words)
    made = {path.parents[2].name for path in Path("outputs").glob("*/checkpoints/last/pretrained_model")}
    assert made == {"few_policy", "more_policy", "longer_policy", "shown_policy", "asked_policy"}
    assert json.loads(Path("outputs/more/meta/info.json").read_text())["total_episodes"] == 4
