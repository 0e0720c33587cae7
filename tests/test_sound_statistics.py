"""Statistics of sound: of all samples, and what LeRobot's own tools and others' checkers make of that."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_factory import MICROPHONE, dataset_features, random_frame
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets import LeRobotDataset, merge_datasets, recompute_stats
from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
from lerobot.processor import NormalizerProcessorStep, TransitionKey

from lerobot_playbyear.datasets import episode_waveform
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.inspection import DatasetSource, check_numbers

FPS, RATE, SIZE = 20, 1600, 80
LENGTHS = (60, 40)


def record(root: Path, seed: int = 0, resume: bool = False) -> Path:
    features = {
        key: feature
        for key, feature in dataset_features(FPS, RATE, 16).items()
        if key in (MICROPHONE, "observation.state", "action")
    }
    rng = np.random.default_rng(seed)
    with DurableWriter("tests/heard", root, FPS, features, resume=resume) as writer:
        for length in LENGTHS:
            for _ in range(length):
                writer.add_frame({**random_frame(features, rng), "task": "listen"})
            writer.save_episode()
    return root


def load(root: Path) -> LeRobotDataset:
    return LeRobotDataset("tests/heard", root=root, video_backend="pyav")


def statistics_verdict(root: Path) -> str:
    (verdict,) = [each for each in check_numbers(DatasetSource(load(root))) if each.check == "statistics"]
    return f"{verdict.level}: {verdict.message}"


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("ours") / "dataset")


@pytest.fixture(scope="module")
def recomputed(ours, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("recomputed") / "dataset"
    shutil.copytree(ours, root)
    recompute_stats(load(root))
    return root


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


def test_lerobots_recompute_stats_writes_what_such_a_checker_wants(recomputed):
    dataset = load(recomputed)
    found = per_element(dataset)
    for name in ("min", "max", "mean", "std", "q50"):
        np.testing.assert_allclose(dataset.meta.stats[MICROPHONE][name], found[name], rtol=1e-5)
    assert statistics_verdict(recomputed).startswith("ok")


def test_both_kinds_of_statistics_merge_and_go_on(ours, recomputed, tmp_path):
    merged = merge_datasets([load(ours), load(recomputed)], "tests/heard", tmp_path / "merged")
    assert int(merged.meta.stats[MICROPHONE]["count"][0]) == 2 * sum(LENGTHS)
    assert statistics_verdict(tmp_path / "merged").startswith("ok")
    shutil.copytree(recomputed, tmp_path / "longer")
    record(tmp_path / "longer", seed=1, resume=True)
    assert int(load(tmp_path / "longer").meta.stats[MICROPHONE]["count"][0]) == 2 * sum(LENGTHS)
    assert statistics_verdict(tmp_path / "longer").startswith("ok")


@pytest.mark.parametrize("mode", [NormalizationMode.MEAN_STD, NormalizationMode.MIN_MAX, NormalizationMode.QUANTILES])
def test_lerobots_normaliser_takes_them_for_a_policy_that_knows_nothing_of_sound(ours, mode):
    dataset = load(ours)
    feature = PolicyFeature(FeatureType.STATE, (SIZE,))
    step = NormalizerProcessorStep({MICROPHONE: feature}, {FeatureType.STATE: mode}, dataset.meta.stats)
    sound = torch.stack([dataset[i][MICROPHONE].float() for i in range(sum(LENGTHS))])
    done = step({TransitionKey.OBSERVATION: {MICROPHONE: sound}})[TransitionKey.OBSERVATION][MICROPHONE]
    assert done.shape == sound.shape
    if mode is NormalizationMode.MEAN_STD:
        assert done.mean() == pytest.approx(0, abs=1e-2)
        assert done.std() == pytest.approx(1, abs=1e-2)
    elif mode is NormalizationMode.MIN_MAX:
        assert done.min() == pytest.approx(-1, abs=1e-3)
        assert done.max() == pytest.approx(1, abs=1e-3)
