"""The two distributions do without each other: tasks without torch and LeRobot, the policy without MuJoCo."""

import pytest
from support.commands import run_without


def test_the_tasksrun_without_torch_and_lerobot():
    code = """
import gymnasium
env = gymnasium.make("gym_playbyear:gym_playbyear/OccludedGrasp-v1")
env.reset(seed=0)
observation, *_ = env.step(env.unwrapped.scripted_expert().act())
print(sorted(observation))
"""
    blocked = {"torch", "torchaudio", "torchvision", "lerobot", "lerobot_playbyear", "lerobot_env_playbyear"}
    assert run_without(blocked, code).strip() == "['agent_pos', 'audio.gripper', 'pixels']"


@pytest.mark.slow
def test_every_module_of_the_policy_imports_without_mujoco_and_the_tasks():
    code = """
import importlib, pkgutil
import lerobot_playbyear, lerobot_policy_playbyear
for package in (lerobot_playbyear, lerobot_policy_playbyear):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
        print(module.name)
"""
    imported = run_without({"mujoco", "gym_playbyear", "lerobot_env_playbyear"}, code).split()
    assert {"lerobot_playbyear.recording.record", "lerobot_playbyear.scripts.commands"} <= set(imported)


def test_what_a_rollout_worker_imports_needs_neither_lerobot_nor_torch():
    """Otherwise each worker takes half a minute to start on a slow machine."""
    run_without({"torch", "lerobot"}, "import lerobot_playbyear.episodes.pool, lerobot_playbyear.scripts.commands")
