"""Stable-Baselines3 takes every task: by a wrapper, and as the example shows it."""

import re
import runpy
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from gym_playbyear import TASKS
from gym_playbyear.wrappers import FlatObservation

EXAMPLE = Path(__file__).parent.parent / "examples" / "learn_with_stable_baselines3.py"


def make(task: str, **options) -> gym.Env:
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", **{"image_size": 36, **options})


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_its_checker_passes_every_task(task):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = FlatObservation(make(task, horizon=3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env)
    env.close()


@pytest.mark.parametrize("sound", ["waveform", "contact_force", "none"])
def test_the_wrapper_gives_the_same_observation_in_one_dictionary_without_dots(sound):
    env, plain = FlatObservation(make("KeyBag-Hard-v1", sound=sound)), make("KeyBag-Hard-v1", sound=sound)
    rng = np.random.default_rng(0)
    flat, nested = env.reset(seed=1)[0], plain.reset(seed=1)[0]
    for _ in range(3):
        assert env.observation_space.contains(flat)
        expected = {"pixels_front": nested.pop("pixels")["front"], "agent_pos": nested.pop("agent_pos")}
        for key, value in nested.items():
            is_sound = key.startswith("audio.")
            expected[key.replace(".", "_")] = np.float32(value / 32768) if is_sound else value
        assert flat.keys() == expected.keys()
        for key in flat:
            np.testing.assert_array_equal(flat[key], expected[key])
            assert flat[key].dtype == (np.uint8 if key.startswith("pixels") else np.float32)
        action = rng.uniform(-0.5, 0.5, 4).astype(np.float32)
        flat, nested = env.step(action)[0], plain.step(action)[0]
    assert sum(key.startswith("audio_") for key in flat) == (2 if sound == "waveform" else 0)
    env.close()
    plain.close()


def test_an_environment_without_a_dictionary_is_refused():
    with pytest.raises(TypeError, match="FlatObservation needs observations in a dictionary, got Box"):
        FlatObservation(gym.make("Pendulum-v1"))


class Spoken(gym.Env):
    """Of somebody else: dictionaries in dictionaries, and keys with dots."""

    observation_space = spaces.Dict(
        {"a.b": spaces.Dict({"c": spaces.Dict({"mic.left": spaces.Box(-32768, 32767, (2,), np.int16)})})}
    )
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return {"a.b": {"c": {"mic.left": np.array([-32768, 16384], np.int16)}}}, {}


def test_dictionaries_may_lie_deep():
    env = FlatObservation(Spoken())
    assert {key: value.tolist() for key, value in env.reset()[0].items()} == {"a_b_c_mic_left": [-1.0, 0.5]}
    assert env.observation_space.contains(env.reset()[0])


def test_the_example_learns_with_its_multi_input_policy_and_leaves_no_folder(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["example", "--steps=8", "--n_steps=4", "--n_envs=2", "--image_size=36"])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert re.search(r"8 steps of OccludedGrasp-v1.*agent_pos, audio_gripper, pixels_front", capsys.readouterr().out)
    assert list(tmp_path.glob("SB3*")) == []
