"""LeRobot's own tools, which know nothing of sound, work on datasets that have it."""

import importlib.util
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torchvision
from dataset_factory import MICROPHONE, make_dataset
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_edit_dataset

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.datasets import EpisodeStore, audio_keys, episode_waveform
from lerobot_playbyear.inspection import DatasetSource, check_numbers
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record

LENGTHS = (12, 17, 9, 14)

Edit = Callable[..., None]


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> LeRobotDataset:
    return make_dataset(tmp_path_factory.mktemp("peers") / "original", LENGTHS, image_size=16)


@pytest.fixture
def edit(monkeypatch) -> Edit:
    """`lerobot-edit-dataset` with these options."""

    def run(*options: str) -> None:
        monkeypatch.setattr(sys, "argv", ["lerobot-edit-dataset", *options])
        lerobot_edit_dataset.main()

    return run


def load(root: Path) -> LeRobotDataset:
    return LeRobotDataset("tests/edited", root=root, video_backend="pyav")


def assert_episodes(edited: LeRobotDataset, original: LeRobotDataset, episodes: list[int]) -> None:
    """The edited dataset holds these episodes of the original, sound and all, and nothing is wrong with it."""
    assert edited.num_episodes == len(episodes)
    assert edited.features[MICROPHONE]["info"] == original.features[MICROPHONE]["info"]
    for position, episode in enumerate(episodes):
        waveform, sample_rate = episode_waveform(edited, position, MICROPHONE)
        expected, _ = episode_waveform(original, episode, MICROPHONE)
        assert sample_rate == 16000
        assert waveform.dtype == np.int16
        np.testing.assert_array_equal(waveform, expected)
    assert EpisodeStore.from_dataset(edited).column(MICROPHONE).shape == (sum(LENGTHS[e] for e in episodes), 800)
    wrong = [verdict for verdict in check_numbers(DatasetSource(edited)) if verdict.level == "error"]
    assert wrong == []


def test_deleted_episodes_take_their_sound_with_them(edit, original, tmp_path):
    target = f"--new_root={tmp_path / 'new'}"
    edit(
        "--repo_id=tests/noise",
        f"--root={original.root}",
        "--new_repo_id=tests/edited",
        target,
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[0, 2]",
    )
    assert_episodes(load(tmp_path / "new"), original, [1, 3])


def test_a_dataset_is_split_and_merged_again(edit, original, tmp_path):
    edit(
        "--repo_id=tests/noise",
        f"--root={original.root}",
        f"--new_root={tmp_path}",
        "--operation.type=split",
        '--operation.splits={"first": [0, 2], "second": [1, 3]}',
    )
    assert_episodes(load(tmp_path / "first"), original, [0, 2])
    assert_episodes(load(tmp_path / "second"), original, [1, 3])
    edit(
        "--new_repo_id=tests/edited",
        f"--new_root={tmp_path / 'merged'}",
        "--operation.type=merge",
        "--operation.repo_ids=['tests/second', 'tests/first']",
        f"--operation.roots=['{tmp_path / 'second'}', '{tmp_path / 'first'}']",
    )
    assert_episodes(load(tmp_path / "merged"), original, [1, 3, 0, 2])


def test_a_microphone_can_be_removed(edit, original, tmp_path):
    edit(
        "--repo_id=tests/noise",
        f"--root={original.root}",
        "--new_repo_id=tests/edited",
        f"--new_root={tmp_path / 'new'}",
        "--operation.type=remove_feature",
        f"--operation.feature_names=['{MICROPHONE}']",
    )
    deaf = load(tmp_path / "new")
    assert audio_keys(deaf.features) == []
    assert len(deaf) == sum(LENGTHS)
    assert MICROPHONE not in deaf.meta.stats


# What takes minutes. Each runs LeRobot's command as a person does; what LeRobot needs besides is not installed here.


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    dataset = RecordDatasetConfig("tests/recorded", str(tmp_path_factory.mktemp("recorded") / "dataset"), 2)
    return record(RecordConfig(PlaybyearEnvConfig(), dataset, num_workers=0))


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """In place of the ImageNet weights that ACT fetches from the network when it is made."""
    folder = tmp_path_factory.mktemp("torch")
    path = folder / "hub" / "checkpoints" / Path(torchvision.models.ResNet18_Weights.IMAGENET1K_V1.url).name
    path.parent.mkdir(parents=True)
    torch.save(torchvision.models.resnet18().state_dict(), path)
    return folder


def run(*command: str, **environment: str) -> str:
    """A command of this virtual environment; its output."""
    path = str(Path(sys.executable).parent / command[0])
    result = subprocess.run(
        [path, *command[1:]], capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout + result.stderr


def needs(module: str, extra: str) -> pytest.MarkDecorator:
    missing = importlib.util.find_spec(module) is None
    return pytest.mark.skipif(missing, reason=f"needs {module}: uv pip install 'lerobot[{extra}]'")


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["act", pytest.param("diffusion", marks=needs("diffusers", "diffusion"))])
def test_lerobots_policies_train_on_it_and_act_without_special_options(policy, recorded, weights, tmp_path):
    output = run(
        "lerobot-train",
        f"--policy.type={policy}",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=tests/recorded",
        f"--dataset.root={recorded}",
        f"--output_dir={tmp_path / 'train'}",
        "--steps=2",
        "--batch_size=2",
        "--num_workers=0",
        "--log_freq=1",
        TORCH_HOME=str(weights),
    )
    assert Counter(word.split(":")[0] for word in output.split() if word.startswith("loss:"))["loss"] == 2
    run(
        "lerobot-eval",
        f"--policy.path={tmp_path / 'train/checkpoints/last/pretrained_model'}",
        "--env.type=playbyear",
        "--env.episode_length=3",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'eval'}",
        TORCH_HOME=str(weights),
    )
    assert (tmp_path / "eval" / "eval_info.json").is_file()


@pytest.mark.slow
@needs("rerun", "viz")
def test_an_episode_is_saved_for_reruns_viewer(recorded, tmp_path):
    run(
        "lerobot-dataset-viz",
        "--repo-id=tests/recorded",
        f"--root={recorded}",
        "--episode-index=1",
        "--save=1",
        f"--output-dir={tmp_path}",
        "--num-workers=0",
    )
    saved = (tmp_path / "tests_recorded_episode_1.rrd").read_bytes()
    assert saved.startswith(b"RRF")
    assert b"observation.images.front" in saved
