"""Acting too early is told beside success: the hand closes before anything was heard, or leaves before the drop was heard."""

import copy
import json
import logging

import numpy as np
import pytest
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from support.playing import finish, make

from gym_playbyear import TASKS
from lerobot_env_playbyear import PlaybyearEnvConfig

OPEN, CLOSE = -1.0, 1.0


@pytest.mark.parametrize("task", TASKS)
def test_experts_solve_the_tasks_and_hear_first(task):
    """Of 100 episodes: the slow test of `test_check.py`."""
    env = make(task)
    for seed in range(2):
        env.reset_physics(seed=seed)
        info = finish(env, env.scripted_expert())
        assert info["is_success"]
        assert info["acted_early"] is False


def after(env, *commands: tuple[float, int, float]) -> dict:
    """What the last step says of some steps: (sideways [5 cm], how many, gripper)."""
    for sideways, n_steps, grip in commands:
        for _ in range(n_steps):
            *_, info = env.step_physics(np.array([0, sideways, 0, grip]))
    return info


def test_a_hand_that_closes_in_the_air_was_early_and_one_that_stays_open_was_not():
    for commands, early in ((((0, 10, OPEN), (0, 10, CLOSE)), True), (((0, 20, OPEN),), False)):
        env = make("OccludedGrasp-v1", horizon=20)
        env.reset_physics(seed=3)
        told = {"is_success": False, "end": "time", "acted_early": early, "n_closings": int(early)}
        assert after(env, *commands) == told


@pytest.mark.parametrize(("sideways", "early"), [(0.0, False), (0.6, True)])
def test_a_hand_that_moves_on_while_the_pouch_falls_was_early(sideways, early):
    env = make("TellApart-v1")
    env.reset_physics(seed=1)
    script = env.scripted_expert()
    while not script.was_dropped:
        env.step_physics(script.act())
    with_hand_open = script.act()
    with_hand_open[1] += sideways
    for _ in range(4):
        env.step_physics(np.clip(with_hand_open, -1, 1))
    assert env._early_action._is_decided
    assert env._early_action.acted_early is early
    assert copy.deepcopy(env)._early_action.acted_early is early
    env.reset_physics(seed=2)
    assert env._early_action.acted_early is False


def vector_env(path=None, use_async_envs=False):
    config = PlaybyearEnvConfig(task="OccludedGrasp-v1", episode_length=3, attempts_file=path and str(path))
    return config.create_envs(2, use_async_envs)["playbyear"][0]


def test_every_attempt_leaves_one_line_in_the_file(tmp_path):
    path = tmp_path / "deep" / "attempts.jsonl"
    envs = vector_env(path)
    for first in (11, 13):
        envs.reset(seed=[first, first + 1], options={NEW_ROLLOUT_OPTION: True})
        for _ in range(5):  # beyond the end, as in a rollout whose slowest attempt goes on
            envs.step(np.array([[0, 0, 0, CLOSE], [0, 0, 0, OPEN]], np.float32))
    envs.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["seed"] for line in lines] == [11, 12, 13, 14]
    assert lines[0].keys() == {"seed", "steps", "is_success", "end", "acted_early", "n_closings", "failure"}
    assert {(line["steps"], line["end"], line["is_success"]) for line in lines} == {(3, "time", False)}


@pytest.mark.parametrize("use_async_envs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_every_evaluation_says_in_how_many_episodes_the_hand_acted_early(use_async_envs, caplog):
    envs = vector_env(use_async_envs=use_async_envs)
    caplog.set_level(logging.INFO)
    for first in (11, 13):
        envs.reset(seed=[first, first + 1], options={NEW_ROLLOUT_OPTION: True})
        for _ in range(4):
            envs.step(np.array([[0, 0, 0, CLOSE], [0, 0, 0, OPEN]], np.float32))
    assert envs.acted_early == (True, False, True, False)
    envs.reset(seed=[15, 16], options={NEW_ROLLOUT_OPTION: True})
    assert envs.acted_early[4:] == (None, None)
    envs.close()
    assert caplog.messages[-1] == "Acted before anything was heard: 50.0% of 4 episodes"
