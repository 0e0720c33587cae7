"""`playbyear-record`: what is on disk, and what is said when it cannot be."""

import multiprocessing
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.configs.dataset import DatasetRecordConfig
from recording_factory import load

from gym_playbyear.environment import TaskEnv
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes import frames
from lerobot_playbyear.episodes.environment import RolloutError, env_spec
from lerobot_playbyear.episodes.pool import RolloutPool
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record


def config(root: Path, num_episodes: int = 2, **options) -> RecordConfig:
    env = options.pop("env", None) or PlaybyearEnvConfig(image_size=16)
    dataset = RecordDatasetConfig("test/recorded", str(root), num_episodes, video=options.pop("video", False))
    return RecordConfig(env, dataset, num_workers=options.pop("num_workers", 0), **options)


def tables(root: Path) -> list[dict]:
    return [pq.read_table(path).to_pylist() for path in sorted(root.glob("data/*/*.parquet"))]


def test_the_dataset_holds_what_the_contract_says(recorded):
    dataset = load(recorded)
    own = {key: (f["dtype"], tuple(f["shape"])) for key, f in dataset.features.items()}
    expected = {
        "observation.images.front": ("image", (16, 16, 3)),
        "observation.state": ("float32", (7,)),
        "observation.audio.gripper": ("int16", (800,)),
        "action": ("float32", (4,)),
        "intervention": ("bool", (1,)),
        "next.reward": ("float32", (1,)),
        "next.success": ("bool", (1,)),
        "next.done": ("bool", (1,)),
        "seed": ("int64", (1,)),
    }
    assert {key: own[key] for key in expected} == expected
    assert dataset.features["observation.audio.gripper"]["info"] == {"sample_rate": 16000, "encoding": "pcm_s16"}
    assert dataset.num_episodes == 2
    assert dataset.fps == 20
    assert dataset[0]["task"]


def test_frame_t_is_the_observation_at_t_and_the_action_taken_then(recorded):
    """Playing the recorded actions from the recorded seed gives the recorded observations back, bit for bit."""
    dataset = load(recorded)
    end = dataset.meta.episodes[0]["dataset_to_index"]
    rows = [dataset[i] for i in range(end)]
    env = env_spec(PlaybyearEnvConfig(image_size=16)).make()
    observation, _ = env.reset(seed=int(rows[0]["seed"]))
    for i, row in enumerate(rows):
        pixels = (row["observation.images.front"].permute(1, 2, 0) * 255).round().numpy().astype(np.uint8)
        np.testing.assert_array_equal(pixels, observation["pixels"]["front"])
        np.testing.assert_array_equal(row["observation.audio.gripper"].numpy(), observation["audio.gripper"])
        np.testing.assert_array_equal(row["observation.state"].numpy(), observation["agent_pos"])
        observation, reward, terminated, truncated, info = env.step(row["action"].numpy())
        assert bool(row["next.success"]) == info["is_success"]
        assert bool(row["next.done"]) == (terminated or truncated) == (i == end - 1)
        assert float(row["next.reward"]) == pytest.approx(reward)
        assert bool(row["intervention"])
    env.close()
    assert info["is_success"]


def test_workers_and_resuming_do_not_change_the_dataset(recorded, tmp_path):
    """As in lerobot-record, who resumes asks for so many more."""
    root = tmp_path / "dataset"
    record(config(root, num_episodes=1, num_workers=2))
    record(config(root, num_episodes=1, num_workers=0, resume=True))
    assert tables(root) == tables(recorded)


def test_options_are_named_as_in_lerobot_record_and_what_is_done_otherwise_is_said(tmp_path, capsys):
    own, lerobots = ({option.name for option in fields(kind)} for kind in (RecordDatasetConfig, DatasetRecordConfig))
    assert own <= lerobots
    cfg = config(tmp_path / "dataset", num_episodes=1)
    cfg.dataset.single_task, cfg.dataset.fps = "Find the tin", 20
    assert load(record(cfg))[0]["task"] == "Find the tin"
    assert (
        "Unlike in lerobot-record, pictures are stored without loss (else --dataset.video=true) and nothing is uploaded "
        "(else --dataset.push_to_hub=true) and the name gets no date." in capsys.readouterr().out
    )


def test_only_successes_are_kept_and_seeds_count_the_attempts(tmp_path):
    """With a horizon that only quick episodes meet, the seeds of the others are missing."""
    root = record(
        config(tmp_path / "dataset", num_episodes=3, env=PlaybyearEnvConfig(image_size=16, episode_length=88))
    )
    dataset = load(root)
    seeds = sorted({int(row["seed"]) for table in tables(root) for row in table})
    assert len(seeds) == 3
    assert seeds != [0, 1, 2]
    ends = [row["dataset_to_index"] - 1 for row in dataset.meta.episodes]
    assert all(bool(dataset[end]["next.success"]) for end in ends)


# What goes wrong, each with one clear error


def test_an_expert_that_never_succeeds(tmp_path):
    with pytest.raises(PlaybyearError, match="failed 20 times in a row"):
        record(config(tmp_path / "dataset", env=PlaybyearEnvConfig(image_size=16, sound="none", episode_length=3)))


@pytest.mark.slow
def test_without_an_opengl_library_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")  # in the worker: needs a display
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    with pytest.raises(PlaybyearError, match=r"No OpenGL context.*libegl1"):
        record(config(tmp_path / "dataset", num_workers=1))
    assert not (tmp_path / "dataset").exists()


def test_a_dead_worker_is_reported():
    others = set(multiprocessing.active_children())
    with closing(RolloutPool(env_spec(PlaybyearEnvConfig()), num_workers=1)) as pool:
        pool.facts()
        (worker,) = set(multiprocessing.active_children()) - others
        worker.kill()
        with pytest.raises(RolloutError, match="worker died"):
            next(pool.episodes([0]))


def test_an_environment_without_an_expert(tmp_path, monkeypatch):
    monkeypatch.setattr(TaskEnv, "scripted_expert", None)
    with pytest.raises(PlaybyearError, match="has no scripted expert"):
        record(config(tmp_path / "dataset"))
    assert not (tmp_path / "dataset").exists()


def test_an_environment_that_breaks_its_word_in_the_middle_is_an_error_of_input(tmp_path, monkeypatch):
    def frames_of(*args, real=frames.episode_frames):
        return [{**frame, "action": frame["action"][:-1]} for frame in real(*args)]

    monkeypatch.setattr(frames, "episode_frames", frames_of)
    with pytest.raises(PlaybyearError, match="action"):
        record(config(tmp_path / "dataset"))
