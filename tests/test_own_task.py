"""Tasks, materials and microphones of other distributions: found by their names, and harmless when they are broken."""

import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from draccus.utils import DecodingError
from lerobot.utils.import_utils import register_third_party_plugins
from support.distributions import install, install_example
from support.shared import TINY, n_evaluated, run_in_process

import gym_playbyear
from gym_playbyear.environment import TaskEnv
from gym_playbyear.registry import PluginError, make_definition
from gym_playbyear.sound.materials import material
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.scripts.commands import record, train

ENV = ["--env.type=playbyear", "--env.task=StopAtTheTin-v1", "--env.image_size=16"]
BROKEN = """
[gym_playbyear.tasks]
Broken-v1 = module_that_is_not_there:task
no name at all! = json:dumps
OccludedGrasp-v1 = json:dumps
[gym_playbyear.materials]
no_material = json:dumps
[gym_playbyear.microphones]
no_microphone = json:dumps
"""


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """The example, and beside it a broken distribution."""
    site = tmp_path_factory.mktemp("own_task") / "site"
    install_example("own_task", site)
    install("broken", site, entry_points=BROKEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        with pytest.warns(UserWarning, match="'no name at all!' is left out"):
            gym_playbyear.register_tasks()
        register_third_party_plugins()
        yield
    sys.modules.pop("stop_at_the_tin", None)


def test_its_expert_solves_it_and_its_material_and_its_microphone_are_heard():
    assert len(material("tin_can").frequencies) == 4
    config = PlaybyearEnvConfig(task="OccludedGrasp-v1", microphones=["gripper", "base"])
    assert config.features["audio.base"].shape == (800,)
    env = gym.make("gym_playbyear/StopAtTheTin-v1", image_size=8, microphones=("gripper", "base"))
    for seed in range(2):
        first = env.reset(seed=seed)[0]
        assert first["audio.base"].any()
        assert not np.array_equal(first["audio.base"], first["audio.gripper"])
        expert, loudest, done = env.unwrapped.scripted_expert(), 0, False
        while not done:
            observation, _, terminated, truncated, info = env.step(expert.act())
            loudest = max(loudest, int(np.abs(observation["audio.gripper"]).max()))
            done = terminated or truncated
        assert info["end"] == "success"
        assert loudest > 500
    env.close()


def test_lerobot_records_trains_and_evaluates_it_without_a_change_here(tmp_path):
    data = ["--dataset.repo_id=me/tin", f"--dataset.root={tmp_path / 'dataset'}"]
    assert run_in_process(record, *ENV, *data, "--dataset.num_episodes=1", "--num_workers=0") is None
    assert run_in_process(train, *TINY, *data, "--steps=1", f"--output_dir={tmp_path / 't'}") is None
    checkpoint = tmp_path / "t/checkpoints/last/pretrained_model"
    assert n_evaluated(checkpoint, tmp_path / "eval", *ENV, "--env.episode_length=5") == 1


def test_a_broken_distribution_says_so_and_breaks_nothing_else():
    with pytest.raises(PluginError, match=r"'Broken-v1' of broken .*module_that_is_not_there"):
        TaskEnv("Broken-v1")
    with pytest.raises(DecodingError, match="Broken-v1"):
        PlaybyearEnvConfig(task="Broken-v1")
    with pytest.raises(ValueError, match=r"Material 'marble' is not known: choose one of bag, .*tin_can"):
        material("marble")
    with pytest.raises(ValueError, match=r"'no_material' of .*materials is a .*; wanted a .*materials\.Material"):
        material("no_material")
    with pytest.raises(
        ValueError, match=r"'no_microphone' of the entry points gym_playbyear\.microphones is a builtins"
    ):
        TaskEnv("OccludedGrasp-v1", microphones=("no_microphone",))

    assert TaskEnv("OccludedGrasp-v1", sound="none").task == "OccludedGrasp-v1"  # ours: nobody replaces it


def test_a_task_whose_physics_does_not_divide_its_control_steps_says_so():
    with pytest.raises(ValueError, match=r"StopAtTheTin-v1: physics_dt=0.003 s .* for example to 0.002"):
        replace(make_definition("StopAtTheTin-v1", {}), physics_dt=0.003)
