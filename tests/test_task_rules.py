"""Version 1 of the cube tasks: how an attempt ends, and what a twin world is."""

import gymnasium as gym
import numpy as np
import pytest

from gym_playbyear import TASKS

V1 = [task for task in TASKS if task.startswith("Occluded") and task.endswith("-v1")]
OPEN, CLOSE = -1.0, 1.0


def make(task: str, **options):
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", **{"sound": "none", **options}).unwrapped


def go(env, goal, grip: float, *, speed: float = 0.02, n_steps: int = 60) -> dict:
    """Moves the hand to a point (3,) [m, world] in a straight line; the `info` of the last step."""
    info: dict = {}
    for _ in range(n_steps):
        way = np.array(goal) - env.eef_position
        if np.linalg.norm(way) < 0.003:
            break
        move = way * min(1.0, speed / np.linalg.norm(way)) / 0.05
        _, terminated, truncated, info = env.step_physics(np.append(move, grip))
        if terminated or truncated:
            break
    return info


def wait(env, grip: float, n_steps: int) -> dict:
    for _ in range(n_steps):
        _, terminated, truncated, info = env.step_physics(np.array([0, 0, 0, grip]))
        if terminated or truncated:
            break
    return info


def begin(task: str, seed: int = 0, **options):
    env = make(task, **options)
    env.reset_physics(seed=seed, options={"cube_position": (0.0, 0.2), "cube_yaw": 0.0})
    return env


def over(env, offset: float, height: float) -> np.ndarray:
    """A point beside the cube's middle along the table [m], so high above it."""
    return np.array([0.0, 0.2 + offset, 0.8 + height])


@pytest.mark.parametrize("speed", [0.02, 0.001])
@pytest.mark.parametrize("task", V1)
def test_a_finger_that_comes_down_on_the_cube_stops_the_arm(task, speed):
    env = begin(task, horizon=1000)
    go(env, over(env, 0.03, 0.07), OPEN)
    info = go(env, over(env, 0.03, 0.03), OPEN, speed=speed, n_steps=300)
    assert info == {"is_success": False, "end": "pressed", "acted_early": False, "n_closings": 0}


@pytest.mark.parametrize("task", V1)
def test_a_squeeze_and_a_held_cube_that_is_set_down_stop_nothing(task):
    env = begin(task, horizon=1000)
    go(env, over(env, 0.0, 0.07), OPEN)
    go(env, over(env, 0.0, 0.022), OPEN)
    wait(env, CLOSE, 15)
    assert env.contact_forces["gripper-cube"] > 40
    go(env, over(env, 0.0, 0.032), CLOSE)
    assert "end" not in go(env, over(env, 0.0, 0.018), CLOSE, n_steps=20)
    env.close()


@pytest.mark.parametrize("task", V1)
def test_the_third_closing_on_nothing_ends_the_attempt(task):
    env = begin(task, horizon=1000)
    infos = []
    for _ in range(3):
        infos.append(wait(env, CLOSE, 60))
        wait(env, OPEN, 60)
    assert [info.get("end") for info in infos] == [None, None, "groped"]
    env.close()


def test_a_cube_that_is_up_for_less_than_half_a_second_is_not_held():
    env = begin("OccludedGrasp-v1")
    go(env, over(env, 0.0, 0.07), OPEN)
    go(env, over(env, 0.0, 0.022), OPEN)
    wait(env, CLOSE, 15)
    go(env, over(env, 0.0, 0.06), CLOSE)
    assert env.position("cube")[2] > 0.84
    assert not env.step_physics(np.array([0, 0, 0, CLOSE]))[3]["is_success"]
    n_steps, info = 0, {"is_success": False}
    while not info["is_success"]:
        info = env.step_physics(np.array([0, 0, 0, CLOSE]))[3]
        n_steps += 1
    assert 5 <= n_steps <= 11
    assert info["end"] == "success"
    env.close()


def test_time_ends_an_attempt_without_success():
    env = begin("OccludedGrasp-v1", horizon=2)
    assert wait(env, OPEN, 5) == {"is_success": False, "end": "time", "acted_early": False, "n_closings": 0}


@pytest.mark.parametrize("task", V1)
def test_a_second_search_after_a_failed_grasp_fits_into_the_time(task):
    env = make(task)
    ends = []
    for seed in range(10):
        env.reset_physics(seed=seed)
        expert = env.scripted_expert()
        while expert.phase != "hop":
            env.step_physics(expert.act())
        wait(env, CLOSE, 15)  # above the cube: nothing is between the fingers
        corrector = env.intervention_gate().expert
        corrector.begin_at("retreat")
        done = False
        while not done:
            if corrector.phase == "lower" and env.finger_positions.sum() < 0.05:
                corrector.phase = "approach"  # until the fingers obey and open
            _, terminated, truncated, info = env.step_physics(corrector.act())
            done = terminated or truncated
        ends.append(info["end"])
    env.close()
    assert "time" not in ends
    assert ends.count("success") >= 0.75 * len(ends)  # the others shove the cube, which both searches move


@pytest.mark.parametrize("task", V1)
def test_the_twin_world_is_the_same_until_touch(task):
    """Every observation, byte for byte; from the touch on the worlds differ in sound."""
    env, twin = (gym.make(f"gym_playbyear:gym_playbyear/{task}", hidden_object=there) for there in (True, False))
    observation, other = (world.reset(seed=3)[0] for world in (env, twin))
    expert = env.unwrapped.scripted_expert()
    while env.unwrapped.contact_forces["gripper-cube"] == 0:
        np.testing.assert_array_equal(observation["pixels"]["front"], other["pixels"]["front"])
        for name in ("agent_pos", "audio.gripper"):
            np.testing.assert_array_equal(observation[name], other[name])
        action = expert.act()
        observation, other = (world.step(action)[0] for world in (env, twin))
    n_heard = 0
    while expert.phase != "hop":
        n_heard += not np.array_equal(observation["audio.gripper"], other["audio.gripper"])
        action = expert.act()
        observation, other = (world.step(action)[0] for world in (env, twin))
    assert n_heard > 0
    assert twin.unwrapped.contact_forces["gripper-cube"] == 0
    env.close()
    twin.close()
