"""The pages about simulation: tutorials' commands run as they stand there, with smaller numbers; the reference is complete."""

import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from support.distributions import install_example
from support.pages import ROOT, blocks, commands_of, installs, run_page

from gym_playbyear import TASKS
from gym_playbyear.check.report import Limits
from gym_playbyear.task import Prop, Task
from lerobot_env_playbyear import PlaybyearEnvConfig

SMALL = {"--dataset.num_episodes": 2, "--steps": 1, "--eval.n_episodes": 1, "--eval.batch_size": 1}
TUTORIALS = ROOT / "docs" / "tutorials"
PAGE = """
```bash
make install && export A=b   # set up
lerobot-x --steps=1250 --env.task=T \\
  --robot.cameras='{gripper: {type: microphone,
    device: "USB Audio"}}' --robot.port=/dev/ttyACM0
```
Not this: `rm -rf x`.
- And, in a list,

  ```bash
  lerobot-y --steps=3
  ```
"""


def test_a_pages_commands_are_read_and_made_small(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    camera = '--robot.cameras={gripper: {type: microphone,\n    device: "USB Audio"}}'
    first = ["lerobot-x", "--steps=2", "--env.task=T"]
    assert commands_of(page, {"--steps": 2}) == [
        ["make", "install"],
        ["export", "A=b"],
        [*first, camera, "--robot.port=/dev/ttyACM0"],
        ["lerobot-y", "--steps=2"],
    ]
    assert commands_of(page, {"--steps": 2, "--robot.*": ["--robot.type=sim"]})[2] == [*first, "--robot.type=sim"]
    with pytest.raises(AssertionError, match=r"nothing in page\.md has --batch_size"):
        commands_of(page, {"--batch_size": 2})
    with pytest.raises(ValueError, match="T"):
        commands_of(page, {"--env.task": 2})  # other numbers, not other tasks
    ran = run_page(lambda *words, environment: (words, environment), page, own={"make": lambda *words: words})
    assert ran[0] == ("install",)
    assert ran[2] == (("lerobot-y", "--steps=3"), {"A": "b"})


def python(*words: str) -> None:
    """A program in a process of its own."""
    subprocess.run([sys.executable, *words], check=True)


@pytest.mark.slow
def test_the_first_policy_in_simulation(commands, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = {**SMALL, "--episodes": 1}
    run_page(commands.succeed, TUTORIALS / "simulation.md", small, {"pip": installs, "python": python})
    for made in ("occluded.html", "rollout.mp4", "eval/eval_info.json", "eval_deaf/eval_info.json"):
        assert (tmp_path / "outputs" / made).stat().st_size > 0


@pytest.mark.slow
def test_a_task_of_ones_own_and_act_and_diffusion_on_it(commands, tmp_path, monkeypatch):
    pytest.importorskip("diffusers")
    site = tmp_path / "site"
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", path)

    def run(*words: str, environment: dict[str, str]) -> None:
        commands.succeed(*words, environment={**environment, "PYTHONPATH": path})

    own = {"pip": lambda _, folder: install_example(Path(folder).name, site), "python": python}
    run_page(run, TUTORIALS / "own_task.md", {**SMALL, "--episodes": 4}, own)
    results = [f"tin{which}_eval/eval_info.json" for which in ("", "_act", "_diffusion")]
    for made in ("tin.mp4", "tin_check.json", *results):
        assert (tmp_path / "outputs" / made).stat().st_size > 0


def test_a_task_of_ones_own_is_the_examples():
    program = (ROOT / "examples/own_task/stop_at_the_tin.py").read_text()
    excerpts = blocks(TUTORIALS / "own_task.md", "python")
    assert len(excerpts) == 3
    for excerpt in excerpts:
        assert excerpt in program


def test_the_reference_names_all_tasks_their_options_parts_and_limits():
    page = re.sub("```.*?```", "", (ROOT / "docs/reference/tasks.md").read_text(), flags=re.DOTALL)
    code = re.findall("`([^`]+)`", page)
    named = {name for text in code for name in re.findall(r"\w+", text)} | set(code)
    fixed = {
        "fps",
        "features",
        "features_map",
        "max_parallel_tasks",
        "disable_env_checker",
    }  # by the task or by LeRobot
    for_people = {"visualization_width", "visualization_height"}
    options = {field.name for field in fields(PlaybyearEnvConfig)} - fixed - for_people
    parts = {field.name for kind in (Task, Prop, Limits) for field in fields(kind)}
    assert {*TASKS, *options, *parts} <= named
