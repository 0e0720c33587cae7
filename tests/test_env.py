"""The tasks as Gymnasium environments: interface, hidden things, copies, the order of calls, windows."""

import copy
import json
import os
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from support.commands import python
from support.playing import STILL
from virtual_screen import VirtualScreen, needs_screen, wait_for

from gym_playbyear import TASKS

CUBE_TASKS = tuple(task for task in TASKS if task.startswith("Occluded"))


def make(task: str = "OccludedGrasp-v1", **options) -> gym.Env:
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", **options)


def assert_same(some: list[dict], others: list[dict]) -> None:
    """Every array of every observation is."""
    for one, other in zip(some, others, strict=True):
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_equal(one[key], other[key])


def level(block: np.ndarray) -> float:
    """Level of a block of PCM [dB re full scale]."""
    return 10 * np.log10(np.mean((block / 32768.0) ** 2) + 1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_observation_contract(task):
    env = make(task, microphones=("gripper", "table"), image_size=64, sample_rate=48000)
    observation, info = env.reset(seed=0)
    assert observation["pixels"]["front"].shape == (64, 64, 3)
    assert observation["agent_pos"].shape == (7,)
    assert observation["agent_pos"].dtype == np.float32
    for microphone in ("gripper", "table"):
        assert observation[f"audio.{microphone}"].shape == (48000 // env.unwrapped.control_hz,)
        assert observation[f"audio.{microphone}"].dtype == np.int16
    assert info["is_success"] is False
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_same_seed_same_bytes(task):
    env = make(task, image_size=16)

    def record():
        first = env.reset(seed=5)[0]
        expert = env.unwrapped.scripted_expert()
        return [first, *(env.step(expert.act())[0] for _ in range(15))]

    assert_same(record(), record())
    env.close()


def cube_pixels(env):
    """How many pixels of the policy's camera show the cube, from what each pixel shows."""
    renderer = env._cameras["front"]._renderer
    renderer.enable_segmentation_rendering()
    renderer.update_scene(env.data, camera="front")
    shown = renderer.render()[..., 0]
    renderer.disable_segmentation_rendering()
    return int((shown == env.model.geom("cube").id).sum())


@pytest.mark.parametrize("task", CUBE_TASKS)
def test_camera_never_sees_the_resting_cube(task):
    env = make(task, sound="none").unwrapped
    for seed in range(2):
        env.reset(seed=seed)
        expert = env.scripted_expert()
        while expert.phase != "lift":
            assert cube_pixels(env) == 0
            env.step_physics(expert.act())
    env.close()


def test_touch_is_heard_in_its_frame_and_nothing_before():
    env = make(image_size=16).unwrapped
    for seed in range(3):
        env.reset(seed=seed)
        expert, levels = env.scripted_expert(), []
        while env.contact_forces["gripper-cube"] <= 0.2:
            levels.append(level(env.step(expert.act())[0]["audio.gripper"]))
        *floor, touch = levels
        assert max(floor) - min(floor) < 6
        assert touch > np.mean(floor) + 20
    env.close()


def test_bad_action_is_named():
    env = make("OccludedGrasp-v1", sound="none")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="4 finite numbers"):
        env.unwrapped.step(np.array([np.nan, 0, 0, 0]))
    env.close()


@pytest.mark.parametrize("action", [(5.0,) * 4, (-3.0, 0.5, 1e6, -1.5), (0.2, 1.0001, -np.finfo(np.float32).max, 2.0)])
def test_an_action_beyond_its_range_is_clipped(action):
    env, seen = make(image_size=16), []
    for given in (action, np.clip(action, -1, 1)):
        env.reset(seed=2)
        seen.append([env.step(np.array(given, np.float32))[0] for _ in range(3)])
    env.close()
    assert_same(*seen)


def play(env: gym.Env, gate, n_steps: int) -> list[dict]:
    """The expert corrects someone who does not move; what was observed."""
    observations = []
    for _ in range(n_steps):
        action = gate.act() if gate.wants_control(STILL) else STILL
        observations.append(env.step(action)[0])
    return observations


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_a_copy_of_a_running_episode_goes_on_alike_and_by_itself(copied):
    """With its gate, its expert and its sound."""
    env = make("OccludedPickPlace-v1", image_size=16)
    env.reset(seed=3)
    gate = env.unwrapped.intervention_gate()
    for _ in range(120):
        if np.abs(play(env, gate, 1)[-1]["audio.gripper"]).max() > 1000:
            break
    else:
        raise AssertionError("nothing rings yet")
    other, other_gate = copied((env, gate))
    assert other_gate.env is other.unwrapped
    first = [*play(env, gate, 20), env.reset()[0]]
    env.close()
    second = [*play(other, other_gate, 20), other.reset()[0]]
    other.close()
    assert gate.reason == other_gate.reason
    assert_same(first, second)


def test_before_reset_everything_that_needs_an_episode_says_so():
    env = make(render_mode="rgb_array").unwrapped
    needing = {"step": (STILL,), "step_physics": (STILL,), "render": (), "scripted_expert": (), "intervention_gate": ()}
    for name, arguments in needing.items():
        with pytest.raises(ResetNeeded, match=r"reset\(\)"):
            getattr(env, name)(*arguments)
    env.close()


@pytest.mark.parametrize("was_reset", [True, False])
def test_a_closed_environment_refuses_and_opens_nothing(was_reset):
    env = make(render_mode="rgb_array").unwrapped
    if was_reset:
        env.reset(seed=0)
        env.render()
    env.close()
    env.close()
    for one in (env, copy.deepcopy(env)):
        for name, arguments in (("step", (STILL,)), ("step_physics", (STILL,)), ("render", ())):
            with pytest.raises(ClosedEnvironmentError, match=r"closed.*reset\(\)"):
                getattr(one, name)(*arguments)
    assert (env._cameras, env._people) == ({}, None)


def test_reset_opens_a_closed_environment_anew():
    env = make(render_mode="rgb_array")
    first = env.reset(seed=4)[0]
    env.close()
    assert_same([first], [env.reset(seed=4)[0]])
    assert env.render().shape == (480, 480, 3)
    env.step(STILL)
    env.close()


_BASELINES = """
import runpy, sys
sys.argv = ["check", "OccludedGrasp-v1", "--episodes=1", "--players", "expert", "--no-twin"]
runpy.run_module("gym_playbyear.check", run_name="__main__")
"""


@pytest.mark.slow
def test_scripts_need_no_opengl():
    without = {key: value for key, value in os.environ.items() if not key.endswith("DISPLAY")}
    assert "all limits hold" in python(_BASELINES, environment={**without, "MUJOCO_GL": "disable"})


def test_an_episode_that_is_not_looked_at_is_the_same_one():
    env = make(sound="none").unwrapped
    cubes = []
    for begin in (env.reset, env.reset_physics):
        begin(seed=7, options={"cube_yaw": 0.1})
        expert = env.scripted_expert()
        while not env.step_physics(expert.act())[1]:
            pass
        cubes.append(env.position("cube"))
    env.close()
    np.testing.assert_array_equal(*cubes)


@pytest.fixture(scope="module")
def screen():
    screen = VirtualScreen()
    yield screen
    screen.close()


_WATCH = """
import sys, gymnasium
env = gymnasium.make("gym_playbyear:gym_playbyear/" + sys.argv[1], render_mode="human", sound="none")
for cube in (-0.25, 0.25):
    observation, _ = env.reset(seed=0, options={"cube_position": (0.0, cube)})
    print(observation["agent_pos"].tolist(), flush=True)
    sys.stdin.readline()
"""


def spot_on(picture: np.ndarray, before: tuple[float, float] | None) -> tuple[float, float] | None:
    """Row and column of the red cube, in shares of the screen; None: there is none, or it is where it was."""
    found = np.argwhere(picture[..., 0].astype(int) - picture[..., 1:].max(axis=-1) > 80)
    if len(found) < 25:
        return None
    row, column = found.mean(axis=0) / picture.shape[:2]
    return None if before is not None and np.hypot(row - before[0], column - before[1]) < 0.05 else (row, column)


@pytest.mark.slow
@needs_screen
def test_a_window_shows_the_new_episode_at_its_reset_and_changes_nothing(screen):
    """The program does not close it: a window that is open when the process ends must not crash it either."""
    process = subprocess.Popen(
        [sys.executable, "-c", _WATCH, "OccludedGrasp-v1"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**screen.environment, "MUJOCO_GL": "egl"},
    )
    env = make(sound="none")
    place = None
    for cube in (-0.25, 0.25):
        measured = json.loads(process.stdout.readline())
        unseen = env.reset(seed=0, options={"cube_position": (0.0, cube)})[0]["agent_pos"]
        assert measured == unseen.tolist()
        place = wait_for(lambda before=place: spot_on(screen.picture(), before))
        process.stdin.write("\n")
        process.stdin.flush()
    env.close()
    assert process.wait(timeout=60) == 0


_CHECK = """
import json, sys, warnings, gymnasium
from gymnasium.utils.env_checker import check_env
env = gymnasium.make("gym_playbyear:gym_playbyear/" + sys.argv[1], render_mode="rgb_array").unwrapped
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    check_env(env, skip_render_check=False)
env.close()
print(json.dumps([str(w.message) for w in caught]))
"""


@needs_screen
@pytest.mark.parametrize(
    "task", [task if task == "OccludedGrasp-v1" else pytest.param(task, marks=pytest.mark.slow) for task in TASKS]
)
def test_gymnasiums_checker_passes_with_every_way_of_rendering(screen, task):
    printed = python(_CHECK, task, environment={**screen.environment, "MUJOCO_GL": "egl"})
    # The state of an arm has no bounds worth naming; Gymnasium remarks on every such space.
    assert [message for message in json.loads(printed.splitlines()[-1]) if "infinity" not in message] == []
