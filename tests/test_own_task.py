"""Tasks, materials and the rest from other distributions: found by their names, and harmless when they are broken."""

import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import draccus
import gymnasium as gym
import numpy as np
import pytest
from draccus.utils import DecodingError
from lerobot.scripts import lerobot_eval
from lerobot.utils.import_utils import register_third_party_plugins

import gym_playbyear
from gym_playbyear.environment import TaskEnv
from gym_playbyear.registry import PluginError, make_definition
from gym_playbyear.sound.materials import material
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.recording.record import RecordConfig
from lerobot_playbyear.scripts.commands import record, train

EXAMPLE = Path(__file__).parent.parent / "examples" / "own_task"
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
ENV = ["--env.type=playbyear", "--env.task=StopAtTheTin-v1", "--env.image_size=16"]


_EARS = """
from gym_playbyear.sound.microphones import Microphone
BASE = Microphone({"table": 0.7, "link1": 1.0}, hum=3.0)
"""


def _install(site: Path, name: str, code: str, entry_points: str) -> None:
    """Another distribution of one module, as an installer would leave it."""
    (site / f"{name}.py").write_text(code)
    info = site / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """Builds the example's wheel and unpacks it where Python finds distributions; beside it lies a broken distribution."""
    folder = tmp_path_factory.mktemp("own_task")
    shutil.copytree(EXAMPLE, folder / "source")
    subprocess.run([sys.executable, "-c", BUILD, str(folder)], cwd=folder / "source", check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        wheel.extractall(folder / "site")
    broken = folder / "site" / "broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text(
        "[gym_playbyear.tasks]\nBroken-v1 = module_that_is_not_there:task\nno name at all! = json:dumps\n"
        "OccludedGrasp-v1 = json:dumps\n"
        "[gym_playbyear.materials]\nno_material = json:dumps\n[gym_playbyear.microphones]\nno_microphone = json:dumps\n"
    )
    _install(folder / "site", "ears", _EARS, "[gym_playbyear.microphones]\nbase = ears:BASE\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder / "site")
        with pytest.warns(UserWarning, match="'no name at all!' is left out"):
            gym_playbyear.register_tasks()
        register_third_party_plugins()
        yield


def call(command, *arguments: str | Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [command.__name__, *map(str, arguments)])
        command()


def test_the_example_is_short():
    assert (
        sum(len((EXAMPLE / name).read_text().splitlines()) for name in ("stop_at_the_tin.py", "pyproject.toml")) < 100
    )


def test_its_expert_solves_it_and_its_material_is_heard():
    env = gym.make("gym_playbyear/StopAtTheTin-v1")
    for seed in range(4):
        env.reset(seed=seed)
        expert, loudest, done = env.unwrapped.scripted_expert(), 0, False
        while not done:
            observation, _, terminated, truncated, info = env.step(expert.act())
            loudest = max(loudest, int(np.abs(observation["audio.gripper"]).max()))
            done = terminated or truncated
        assert info["end"] == "success"
        assert loudest > 500
    env.close()


def test_a_microphone_of_another_distribution_hears_in_our_tasks():
    config = PlaybyearEnvConfig(task="OccludedGrasp-v1", microphones=["gripper", "base"])
    assert config.features["audio.base"].shape == (800,)
    env = TaskEnv("OccludedGrasp-v1", image_size=8, microphones=("gripper", "base"))
    observation = env.reset(seed=0)[0]
    heard = {name: np.abs(observation[f"audio.{name}"].astype(int)).mean() for name in ("gripper", "base")}
    assert heard["base"] > heard["gripper"] > 0  # its arm hums louder
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"microphones": ("none",)}, r"microphones is \('none',\); name at least one of base, gripper, .*table"),
        (
            {"microphones": ("no_microphone",)},
            r"'no_microphone' of the entry points gym_playbyear\.microphones is a builtins",
        ),
    ],
)
def test_a_microphone_that_is_none_says_so(options, message):
    with pytest.raises(ValueError, match=message):
        TaskEnv("OccludedGrasp-v1", **options)


def test_a_tasks_own_options_keep_their_types(monkeypatch):
    given = {}
    monkeypatch.setitem(
        gym_playbyear.ALL_TASKS._own,
        "Own-v1",
        lambda *, slippery, height: given.update(a=slippery, b=height) or make_definition("OccludedGrasp-v1", {}),
    )
    options = ["--env.type=playbyear", "--env.task=Own-v1", "--env.task_options={slippery: false, height: 0.2}"]
    draccus.parse(RecordConfig, args=[*options, "--dataset.repo_id=a/b"])
    assert given == {"a": False, "b": 0.2}


def test_a_material_that_is_none_says_so():
    assert len(material("tin_can").frequencies) == 4
    with pytest.raises(ValueError, match=r"Material 'marble' is not known: choose one of bag, .*tin_can"):
        material("marble")
    with pytest.raises(
        ValueError, match=r"'no_material' of .*materials is a .*; wanted a .*sound\.materials\.Material"
    ):
        material("no_material")


def test_lerobot_records_trains_and_evaluates_it_without_a_change_here(tmp_path):
    data = ["--dataset.repo_id=me/tin", f"--dataset.root={tmp_path / 'dataset'}"]
    call(record, *ENV, *data, "--dataset.num_episodes=1", "--num_workers=0")
    policy = ["--policy.type=playbyear", "--policy.push_to_hub=false", "--policy.device=cpu", "--policy.image_size=16"]
    call(
        train,
        *policy,
        "--policy.vision_width=4",
        *data,
        "--steps=1",
        "--batch_size=2",
        f"--output_dir={tmp_path / 't'}",
    )
    call(
        lerobot_eval.main,
        f"--policy.path={tmp_path / 't/checkpoints/last/pretrained_model'}",
        *ENV,
        "--env.episode_length=5",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert json.loads((tmp_path / "eval/eval_info.json").read_text())["overall"]["n_episodes"] == 1


def test_a_broken_distribution_says_so_and_breaks_nothing_else():
    assert "Broken-v1" in gym_playbyear.ALL_TASKS
    with pytest.raises(PluginError, match=r"'Broken-v1' of broken .*module_that_is_not_there"):
        TaskEnv("Broken-v1")
    with pytest.raises(DecodingError, match="Broken-v1"):
        PlaybyearEnvConfig(task="Broken-v1")
    assert TaskEnv("OccludedGrasp-v1", sound="none").task == "OccludedGrasp-v1"  # ours: nobody replaces it


def test_an_unknown_task_is_told_which_there_are():
    with pytest.raises(DecodingError, match=r"OccludedGrasp-v1.*StopAtTheTin-v1"):
        PlaybyearEnvConfig(task="Nope-v1")


def test_an_option_of_no_task_is_named():
    with pytest.raises(DecodingError, match="StopAtTheTin-v1 has no such option"):
        PlaybyearEnvConfig(task="StopAtTheTin-v1", task_options={"colour": "blue"})
    with pytest.raises(ValueError, match=r"variant='paper' is not known: OccludedGrasp-v1 has no such option"):
        TaskEnv("OccludedGrasp-v1", variant="paper")
