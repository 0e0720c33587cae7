"""What the experts of the cube tasks show: that the touch alone tells where the cube is; in version 0, what they always did."""

import gymnasium as gym
import numpy as np
import pytest

from gym_playbyear.experts.occluded import GraspExpert


def searches(task: str, seeds: range) -> list[dict[str, float]]:
    """Of the expert's first search in every episode: lengths [m], and steps from the touch to the descent."""
    env = gym.make(f"gym_playbyear:gym_playbyear/{task}", image_size=8, sound="none", disable_env_checker=True)
    told = []
    for seed in seeds:
        env.reset(seed=seed)
        task_env, steps, heights = env.unwrapped, 0, []
        expert = task_env.scripted_expert()
        while expert.phase != "descend":
            if expert.phase == "sweep":
                heights.append(task_env.eef_position[2])
            steps += expert.phase in ("dwell", "rise", "hover", "hop")
            env.step(expert.act())
        beside = abs(task_env.position("cube")[1] - task_env.eef_position[1])
        told.append({"beside": beside, "steps": steps, "height": np.median(heights)})
    env.close()
    return told


CUBES = pytest.mark.parametrize("task", ["OccludedGrasp-v1", "OccludedPickPlace-v1"])


@CUBES
def test_it_comes_down_above_the_cube_while_the_touch_is_remembered(task):
    told = searches(task, range(12))
    assert np.mean([each["beside"] for each in told]) < 0.003
    assert np.mean([each["steps"] <= 18 for each in told]) > 0.8
    assert np.ptp([each["height"] for each in told]) > 0.005


@CUBES
def test_it_draws_back_from_the_cube_by_another_way_in_every_search(task):
    env = gym.make(f"gym_playbyear:gym_playbyear/{task}", image_size=8, sound="none", disable_env_checker=True)
    env.reset(seed=1)
    expert = env.unwrapped.scripted_expert()
    ways = []
    for _ in range(50):
        expert._begin()
        ways.append(expert.back_off)
    low, high = GraspExpert.BACK_OFF
    assert low <= min(ways) < low + 0.003
    assert high - 0.003 < max(ways) <= high
    env.close()


@CUBES
def test_its_hops_miss_the_cube_on_both_sides_and_are_mended(task):
    env = gym.make(f"gym_playbyear:gym_playbyear/{task}", image_size=8, sound="none", disable_env_checker=True)
    missed = []
    for seed in range(8):
        env.reset(seed=seed)
        task_env = env.unwrapped
        expert = task_env.scripted_expert()
        while expert.phase != "hop":
            env.step(expert.act())
        while expert.phase == "hop" and expert.hop_error:
            error, beside = expert.hop_error, task_env.eef_position[1] - task_env.position("cube")[1]
            env.step(expert.act())
        missed.append(error)
        assert abs(beside - error) < 0.004
    low, high = GraspExpert.HOP_ERROR
    assert min(missed) < low / 2
    assert max(missed) > high / 2
    env.close()
