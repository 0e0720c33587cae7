"""LeRobot's own tools, which know nothing of sound, work on datasets that have it."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from dataset_factory import MICROPHONE, dataset_features, make_dataset, random_frame
from lerobot.datasets import LeRobotDataset, merge_datasets, recompute_stats
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.scripts import lerobot_edit_dataset, lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins
from recording_factory import load
from support.recording import errors_in
from support.shared import TINY, run_in_process

from lerobot_playbyear.datasets import audio_feature, audio_keys, episode_waveform
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.inspection import SurveyedDataset, check_numbers
from lerobot_playbyear.training import EpisodeStore

FPS = 20
LENGTHS = (6, 9, 4, 7)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> LeRobotDataset:
    return make_dataset(tmp_path_factory.mktemp("peers") / "original", LENGTHS, image_size=16)


def edit(old: Path | str, new: Path | str, operation: str, *options: str) -> None:
    """`lerobot-edit-dataset`."""
    names = ("--repo_id=tests/noise", f"--root={old}", "--new_repo_id=tests/edited", f"--new_root={new}")
    run_in_process(lerobot_edit_dataset.main, *names, f"--operation.type={operation}", *options)


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
    assert not errors_in(edited.root)


def test_deleted_episodes_take_their_sound_with_them(original, tmp_path):
    edit(original.root, tmp_path / "new", "delete_episodes", "--operation.episode_indices=[0, 2]")
    assert_episodes(load(tmp_path / "new"), original, [1, 3])


def test_deleting_episodes_costs_a_few_bytes(tmp_path):
    """Our sound, of a quiet room, is stored as differences; LeRobot's copy of it is not, and takes little more room."""
    features, rng = {MICROPHONE: audio_feature(16000, FPS)}, np.random.default_rng(0)
    with DurableWriter("tests/quiet", tmp_path / "ours", FPS, features) as writer:
        for _ in range(2):
            for _ in range(200):
                writer.add_frame({MICROPHONE: rng.normal(0, 20, 800).astype(np.int16), "task": "Listen."})
            writer.save_episode()
    edit(tmp_path / "ours", tmp_path / "left", "delete_episodes", "--operation.episode_indices=[0]")
    before, after = (sum(p.stat().st_size for p in (tmp_path / name).glob("data/*/*")) for name in ("ours", "left"))
    assert before / (400 * 800) < 1.1
    assert after / (200 * 800) < 1.2 * before / (400 * 800), "more than docs/reference/dataset_format.md says"


def test_a_dataset_is_split_and_merged_again(original, tmp_path):
    edit(original.root, tmp_path, "split", '--operation.splits={"first": [0, 2], "second": [1, 3]}')
    assert_episodes(load(tmp_path / "first"), original, [0, 2])
    assert_episodes(load(tmp_path / "second"), original, [1, 3])
    run_in_process(
        lerobot_edit_dataset.main,
        *("--new_repo_id=tests/edited", f"--new_root={tmp_path / 'merged'}", "--operation.type=merge"),
        "--operation.repo_ids=['tests/second', 'tests/first']",
        f"--operation.roots=['{tmp_path / 'second'}', '{tmp_path / 'first'}']",
    )
    assert_episodes(load(tmp_path / "merged"), original, [1, 3, 0, 2])


def test_a_microphone_can_be_removed(original, tmp_path):
    edit(original.root, tmp_path / "new", "remove_feature", f"--operation.feature_names=['{MICROPHONE}']")
    deaf = load(tmp_path / "new")
    assert audio_keys(deaf.features) == []
    assert len(deaf) == sum(LENGTHS)
    assert MICROPHONE not in deaf.meta.stats


# Statistics

RATE, SIZE = 1600, 80
HEARD = (60, 40)


def write(root: Path, seed: int = 0, resume: bool = False) -> Path:
    features = {
        key: feature
        for key, feature in dataset_features(FPS, RATE, 16).items()
        if key in (MICROPHONE, "observation.state", "action")
    }
    rng = np.random.default_rng(seed)
    with DurableWriter("tests/heard", root, FPS, features, resume=resume) as writer:
        for length in HEARD:
            for _ in range(length):
                writer.add_frame({**random_frame(features, rng), "task": "listen"})
            writer.save_episode()
    return root


def statistics_verdict(root: Path) -> str:
    (verdict,) = [
        each for each in check_numbers(SurveyedDataset.open("tests/heard", root)) if each.check == "statistics"
    ]
    return f"{verdict.level}: {verdict.message}"


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("ours") / "dataset")


def per_element(dataset: LeRobotDataset) -> dict[str, np.ndarray]:
    """What a checker computes that knows nothing of sound: LeRobot's statistics of every sample index."""
    episodes = [episode_waveform(dataset, i, MICROPHONE)[0].reshape(-1, SIZE) for i in range(dataset.num_episodes)]
    feature = {MICROPHONE: dataset.meta.features[MICROPHONE]}
    return aggregate_stats([compute_episode_stats({MICROPHONE: each}, feature) for each in episodes])[MICROPHONE]


def test_a_checker_that_recomputes_statistics_finds_ours_by_pooling_its_own(ours):
    dataset = load(ours)
    stored, found = dataset.meta.stats[MICROPHONE], per_element(dataset)
    for name in ("min", "max", "mean", "std"):
        assert stored[name].shape == found[name].shape == (SIZE,)
        assert (stored[name] == stored[name][0]).all()
    variance = (found["std"] ** 2 + (found["mean"] - found["mean"].mean()) ** 2).mean()
    pooled = {"min": found["min"].min(), "max": found["max"].max(), "mean": found["mean"].mean(), "std": variance**0.5}
    scale = pooled["max"] - pooled["min"]
    for name, value in pooled.items():
        assert stored[name][0] == pytest.approx(float(value), abs=1e-4 * float(scale)), name
    assert (stored["min"] <= found["min"]).all()
    assert (stored["max"] >= found["max"]).all()
    assert statistics_verdict(ours).startswith("ok")


def test_both_kinds_of_statistics_merge_and_go_on(ours, tmp_path):
    recomputed = shutil.copytree(ours, tmp_path / "recomputed")
    recompute_stats(load(recomputed))
    merged = merge_datasets([load(ours), load(recomputed)], "tests/heard", tmp_path / "merged")
    assert int(merged.meta.stats[MICROPHONE]["count"][0]) == 2 * sum(HEARD)
    assert statistics_verdict(tmp_path / "merged").startswith("ok")
    shutil.copytree(recomputed, tmp_path / "longer")
    write(tmp_path / "longer", seed=1, resume=True)
    assert int(load(tmp_path / "longer").meta.stats[MICROPHONE]["count"][0]) == 2 * sum(HEARD)
    assert statistics_verdict(tmp_path / "longer").startswith("ok")


# Streaming


def test_lerobot_train_learns_from_the_stream(original, tmp_path):
    register_third_party_plugins()
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={original.root}", "--dataset.streaming=true")
    workers = ("--num_workers=1", "--dataloader_multiprocessing_context=fork", "--batch_size=4")
    options = (*TINY, *data, *workers, "--steps=8", f"--output_dir={tmp_path / 'out'}")
    run_in_process(lerobot_train.main, *options)  # 8 batches of 4: the second time through the data, too
    config = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    assert (config["sample_rate"], config["type"]) == (16000, "playbyear")


def needs(module: str, extra: str) -> pytest.MarkDecorator:
    missing = importlib.util.find_spec(module) is None
    return pytest.mark.skipif(missing, reason=f"needs {module}: uv pip install 'lerobot[{extra}]'")


@pytest.mark.slow
@needs("rerun", "viz")
def test_an_episode_is_saved_for_reruns_viewer(recorded, commands, tmp_path):
    where = ("--repo-id=tests/demos", f"--root={recorded}", "--episode-index=1", "--num-workers=0")
    commands.succeed("lerobot-dataset-viz", *where, "--save=1", f"--output-dir={tmp_path}")
    saved = (tmp_path / "tests_demos_episode_1.rrd").read_bytes()
    assert saved.startswith(b"RRF")
    assert b"observation.images.front" in saved
