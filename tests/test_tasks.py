"""The tasks as Gymnasium environments: interface, hidden cube, experts, blind baselines, sound."""

import os
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from gym_playbyear import TASKS
from gym_playbyear.check.report import outcomes

CUBE_TASKS = tuple(task for task in TASKS if task.startswith("Occluded"))


def make(task: str, **options):
    return gym.make(f"gym_playbyear:gym_playbyear/{task}", **options)


def roll_out(env, seed: int):
    """One expert episode: list of (observation, phase, largest contact forces)."""
    env.reset(seed=seed)
    task = env.unwrapped
    expert = task.scripted_expert()
    frames, done = [], False
    while not done:
        phase = expert.phase
        observation, _, terminated, truncated, info = env.step(expert.act())
        frames.append((observation, phase, task.contact_forces))
        done = terminated or truncated
    return frames, info


def level(block: np.ndarray) -> float:
    """Level of a block of PCM [dB re full scale]."""
    return 10 * np.log10(np.mean((block / 32768.0) ** 2) + 1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_checker_passes(task):
    env = make(task, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    # The state of an arm has no bounds worth naming; Gymnasium remarks on every such space.
    assert [str(w.message) for w in caught if "infinity" not in str(w.message)] == []
    env.close()


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


def test_force_proxy_replaces_sound():
    env = make("OccludedGrasp-v1", sound="contact_force")
    observation, _ = env.reset(seed=0)
    assert observation["contact_force"].shape == (6,)
    assert not any(key.startswith("audio.") for key in observation)
    env.close()


@pytest.mark.parametrize("task", TASKS)
def test_same_seed_same_bytes(task):
    env = make(task)

    def record():
        observations = [env.reset(seed=5)[0]]
        expert = env.unwrapped.scripted_expert()
        observations += [env.step(expert.act())[0] for _ in range(40)]
        heard = [key for key in observations[0] if key.startswith("audio.")]
        return [(o["pixels"]["front"], o["agent_pos"], *(o[key] for key in heard)) for o in observations]

    for first, second in zip(record(), record(), strict=True):
        for a, b in zip(first, second, strict=True):
            np.testing.assert_array_equal(a, b)
    env.close()


_DRAW = """
import os, hashlib, gymnasium
env = gymnasium.make("gym_playbyear:gym_playbyear/OccludedGrasp-v1")
picture = env.reset(seed=0)[0]["pixels"]["front"]
print(hashlib.sha256(picture.tobytes()).hexdigest(), os.environ["LP_NUM_THREADS"])
"""


def test_pictures_do_not_depend_on_how_many_threads_draw_them():
    environments = [{}, {"LP_NUM_THREADS": "2"}]
    without = {key: value for key, value in os.environ.items() if key != "LP_NUM_THREADS"}
    drawn = [
        subprocess.run(
            [sys.executable, "-c", _DRAW], capture_output=True, text=True, check=True, env={**without, **environment}
        ).stdout.split()
        for environment in environments
    ]
    assert [n_threads for _, n_threads in drawn] == ["0", "2"]
    assert drawn[0][0] == drawn[1][0]


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
    env = make(task)
    for seed in range(3):
        env.reset(seed=seed)
        env_task = env.unwrapped
        expert = env_task.scripted_expert()
        assert cube_pixels(env_task) == 0
        while expert.phase != "lift":
            env.step(expert.act())
            assert cube_pixels(env_task) == 0
    env.close()


@pytest.mark.parametrize("task", CUBE_TASKS)
def test_expert_succeeds(task):
    assert all(attempt.success for attempt in outcomes(task, "expert", range(10)))


def test_touch_is_heard_in_its_frame_and_nothing_before():
    env = make("OccludedGrasp-v1")
    for seed in range(3):
        frames, _ = roll_out(env, seed)
        touched = [forces["gripper-cube"] > 0.2 for _, _, forces in frames]
        first = touched.index(True)
        levels = [level(observation["audio.gripper"]) for observation, _, _ in frames]
        floor = levels[:first]
        assert max(floor) - min(floor) < 6
        assert levels[first] > np.mean(floor) + 20
    env.close()


def test_reset_options_place_cube_and_bin():
    env = make("OccludedPickPlace-v1")
    env.reset(seed=0, options={"cube_position": (0.0, 0.2), "cube_yaw": 0.1, "bin_position": (0.0, -0.2)})
    np.testing.assert_allclose(env.unwrapped.position("cube")[:2], (0.0, 0.2), atol=1e-3)
    np.testing.assert_allclose(env.unwrapped.position("bin")[:2], (0.0, -0.2))
    env.close()


def test_shoved_cube_ends_the_episode():
    env = make("OccludedGrasp-v1")
    env.reset(seed=0)
    pusher = env.unwrapped.blind_baselines()["push"]
    for _ in range(150):
        _, reward, terminated, truncated, info = env.step(pusher.act())
        if terminated or truncated:
            break
    assert terminated
    assert reward == 0
    assert not info["is_success"]
    env.close()


def test_horizon_truncates():
    env = make("OccludedGrasp-v1", horizon=3)
    env.reset(seed=0)
    flags = [env.step(np.array([0, 0, 0, -1.0]))[3] for _ in range(3)]
    assert flags == [False, False, True]
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sound": "loud"}, "sound='loud'"),
        ({"variant": "easy"}, "variant='easy'"),
        ({"sample_rate": 16001}, "16001"),
        ({"microphones": ("hat",)}, "hat"),
        ({"image_size": 2}, "image_size=2"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        make("OccludedGrasp-v1", **options)


def test_bad_action_is_named():
    env = make("OccludedGrasp-v1", sound="none")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="4 finite numbers"):
        env.unwrapped.step(np.array([np.nan, 0, 0, 0]))
    env.close()


def test_absent_gl_is_explained():
    code = "import gymnasium as gym, gym_playbyear; gym.make('gym_playbyear/OccludedGrasp-v1').reset(seed=0)"
    environment = {
        "MUJOCO_GL": "egl",
        "EGL_PLATFORM": "surfaceless",
        "PATH": "/usr/bin",
        "__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere.json",
    }
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert result.returncode != 0
    assert "MUJOCO_GL=egl" in result.stderr


def sound_of_touch(
    env, seed: int, pair: str, way_points: list[tuple[float, float, float]], cube_y: float
) -> np.ndarray:
    """Drives the arm from point to point [m, world] until `pair` touches; the sound of that frame and the next, as PCM."""
    env.reset(seed=seed, options={"cube_position": (0.0, cube_y)})
    task = env.unwrapped
    speed = np.random.default_rng(seed).uniform(0.008, 0.02)
    for goal in way_points:
        for _ in range(60):
            way = np.array(goal) - task.eef_position
            if np.linalg.norm(way) < 0.005:
                break
            move = way * min(1.0, speed / np.linalg.norm(way)) / 0.05
            observation = env.step(np.append(move, -1.0))[0]
            if task.contact_forces[pair] > 0.2:
                following = env.step(np.array([0.0, 0.0, 0.0, -1.0]))[0]
                return np.concatenate([observation["audio.gripper"], following["audio.gripper"]])
    raise AssertionError(f"{pair} never touched")


def test_touches_of_cube_wall_and_table_are_told_apart_by_their_spectra():
    env = make("OccludedGrasp-v1")
    touches: dict[str, tuple[list[tuple[float, float, float]], float]] = {
        "gripper-cube": ([(0.0, 0.0, 0.88), (0.0, 0.0, 0.822), (0.0, 0.2, 0.822)], 0.1),
        "gripper-wall": ([(0.05, 0.0, 0.95), (0.16, 0.0, 0.95)], 0.2),
        "gripper-table": ([(-0.1, 0.0, 0.85), (-0.1, 0.0, 0.80)], 0.2),
    }
    spectra, labels = [], []
    for label, (pair, (way_points, cube_y)) in enumerate(touches.items()):
        for seed in range(24):
            sound = sound_of_touch(env, seed, pair, way_points, cube_y)
            spectra.append(np.log10(np.abs(np.fft.rfft(sound / 32768.0 * np.hanning(len(sound)))[:320]) + 1e-6))
            labels.append(label)
    env.close()
    features = np.stack(spectra).reshape(len(spectra), 40, 8).mean(axis=2)
    features = np.column_stack([(features - features.mean(axis=0)) / features.std(axis=0), np.ones(len(features))])
    targets = np.eye(3)[labels]
    held_out = np.arange(len(labels)) % 3 == 0
    x, y = features[~held_out], targets[~held_out]
    weights = np.linalg.solve(x.T @ x + 1.0 * np.eye(x.shape[1]), x.T @ y)
    guessed = (features[held_out] @ weights).argmax(axis=1)
    assert (guessed == np.array(labels)[held_out]).mean() >= 0.9


def test_a_cube_of_another_material_moves_alike_and_sounds_different():
    heard = {}
    for material in ("cube", "glass"):
        env = make("OccludedGrasp-v1", cube_material=material)
        frames, _ = roll_out(env, seed=0)
        env.close()
        touched = next(i for i, (_, _, forces) in enumerate(frames) if forces["gripper-cube"] > 0)
        heard[material] = (touched, frames[touched - 1][0], frames[touched][0], frames[touched][2])
    (wood_at, _, wood, wood_forces), (glass_at, _, glass, glass_forces) = heard.values()
    assert (wood_at, wood_forces) == (glass_at, glass_forces)
    spectra = [np.abs(np.fft.rfft(block["audio.gripper"])) ** 2 for block in (wood, glass)]
    bins = np.fft.rfftfreq(800, 1 / 16000)
    pitch = [np.average(bins[bins < 5000], weights=power[bins < 5000]) for power in spectra]
    assert pitch[1] > pitch[0] + 200


def test_an_unknown_cube_material_is_refused():
    with pytest.raises(ValueError, match="cube_material='jelly' is not known"):
        make("OccludedGrasp-v1", cube_material="jelly")
