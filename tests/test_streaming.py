"""`lerobot-train --dataset.streaming=true` with the policy `playbyear`: the same windows, and the limits in docs/peers.md."""

import json
import sys

import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, dataset_features, make_dataset
from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset
from lerobot.scripts import lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

FPS = 20
DATA = {"repo_id": "tests/noise", "return_uint8": True}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("streaming") / "noise"
    make_dataset(root, (12, 17, 9), image_size=16)
    return root


def timestamps(n_frames, *keys):
    return {key: [i / FPS for i in range(1 - n_frames, 1)] for key in keys}


def test_the_stream_holds_the_windows_of_the_dataset(root):
    config = PlaybyearConfig(device="cpu")
    observed = timestamps(len(config.observation_delta_indices), CAMERA, MICROPHONE, "observation.state")
    windows = observed | {"action": [i / FPS for i in config.action_delta_indices]}
    expected = LeRobotDataset(root=root, delta_timestamps=windows, **DATA)
    seen = []
    for item in StreamingLeRobotDataset(root=root, delta_timestamps=windows, **DATA):
        seen.append(int(item["index"]))
        same = expected[seen[-1]]
        assert item.keys() == same.keys()
        assert item[MICROPHONE].dtype == torch.int64  # as it was recorded, not yet in [-1, 1]
        for key, value in same.items():
            assert (
                torch.equal(torch.as_tensor(item[key], dtype=value.dtype), value)
                if key != "task"
                else item[key] == value
            )
    assert sorted(seen) == list(range(12 + 17 + 9))


def test_lerobot_train_learns_from_the_stream(root, tmp_path, monkeypatch):
    register_third_party_plugins()
    options = [
        *("--policy.type=playbyear", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.image_size=16"),
        *("--policy.vision_width=8", "--policy.hidden_size=32", "--policy.audio_window_s=0.9"),
        *("--dataset.repo_id=tests/noise", f"--dataset.root={root}", "--dataset.streaming=true", "--num_workers=1"),
        *(
            "--dataloader_multiprocessing_context=fork",
            "--batch_size=4",
            "--steps=12",
            f"--output_dir={tmp_path / 'out'}",
        ),
    ]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *options])
    lerobot_train.main()  # 12 batches of 4: the second time through the data, too
    config = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    assert (config["sample_rate"], config["type"]) == (16000, "playbyear")


def test_lerobots_stream_is_empty_without_worker_processes(root):
    assert len(list(StreamingLeRobotDataset(root=root, max_num_shards=0, **DATA))) == 0  # --num_workers


@pytest.mark.parametrize(("n_frames", "is_whole"), [(100, True), (101, False)])
def test_lerobots_stream_reaches_99_frames_back(tmp_path, n_frames, is_whole):
    make_dataset(tmp_path / "long", (110,), features=dataset_features(cameras=(), microphones=()))
    windows = timestamps(n_frames, "observation.state") | {"action": [0.0]}
    items = StreamingLeRobotDataset(root=tmp_path / "long", delta_timestamps=windows, **DATA)
    pads = {int(item["index"]): bool(item["observation.state_is_pad"].any()) for item in items}
    assert pads[109] != is_whole
    assert not any(frames > 100 for frames in (len(PlaybyearConfig(device="cpu", fps=30).observation_delta_indices),))
