"""Faults of the disk that pass: they end with an error, and no episode that is whole on the disk is lost to them."""

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faulty_disk import ERRORS, READS, WRITES, FaultyDisk
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from recording_factory import FPS, REPO_ID, RICH_FEATURES, differences, episode_frames, load

from lerobot_playbyear.datasets import episode_files
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.repair import repair_dataset

N_EPISODES = 4
ENCODER = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
LOOKING = ("check", "inspect", "load", "store")
SCRATCH = "images"


@pytest.fixture(scope="module")
def disk(tmp_path_factory) -> Iterator[FaultyDisk]:
    disk = FaultyDisk(tmp_path_factory.mktemp("faults"))
    yield disk
    disk.close()


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, Path]:
    """A dataset of ours in several files, and one whose recording with LeRobot was killed: it needs repair."""
    folder = tmp_path_factory.mktemp("originals")
    with (
        pytest.MonkeyPatch.context() as patch,
        DurableWriter(REPO_ID, folder / "ours", FPS, RICH_FEATURES, rgb_encoder=ENCODER) as writer,
    ):
        patch.setattr(episode_files, "SMALL_DATA_BYTES", 20_000)
        patch.setattr(episode_files, "SMALL_TABLE_BYTES", 30_000)
        for number in range(N_EPISODES):
            for frame in episode_frames(number, RICH_FEATURES):
                writer.add_frame(frame)
            writer.save_episode()
    dataset = LeRobotDataset.create(
        REPO_ID, FPS, RICH_FEATURES, root=folder / "recording", video_backend="pyav", rgb_encoder=ENCODER
    )
    for number in range(N_EPISODES):
        for frame in episode_frames(number, RICH_FEATURES):
            dataset.add_frame(frame)
        dataset.save_episode(parallel_encoding=False)
    shutil.copytree(folder / "recording", folder / "killed")
    dataset.finalize()
    return {name: folder / name for name in ("ours", "killed")}


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder, and what it holds; without what is only there while a dataset is written."""
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not (name := path.relative_to(folder).as_posix()).startswith(f"{SCRATCH}/.")
    }


def place(original: Path, folder: Path) -> Path:
    """A copy of a dataset, with neighbours."""
    (folder / "dataset-2").mkdir(parents=True)
    (folder / "dataset-2" / "notes.txt").write_text("of another dataset")
    (folder / "notes.txt").write_text("beside the datasets")
    return Path(shutil.copytree(original, folder / "dataset"))


def neighbours(folder: Path) -> dict[str, str]:
    return {
        name: digest for name, digest in contents(folder).items() if name.split("/")[0] in ("dataset-2", "notes.txt")
    }


def meet_fault(disk: FaultyDisk, original: Path, folder: Path, operation: str, **fault: Any) -> dict[str, Any]:
    """Does one thing while one call fails, and holds what is then on the disk against what was there.

    Args:
        disk: Does it.
        original: The dataset.
        folder: For a copy of it.
        operation: What is done.
        fault: Which call fails; see `FaultyDisk.run`.
    """
    root = place(original, folder)
    before, beside = contents(root), neighbours(folder)
    answer = disk.run(operation, root, **fault)
    story = f"{operation} of {original.name}: {answer}"
    assert not answer.get("crashed"), story
    for untrue in ("DatasetDamagedError", "no episode was saved", "is truncated"):
        assert untrue not in answer.get("error", ""), story

    # What was said while the disk failed is an error, or right.
    saved = 0
    if operation == "record":
        whole = [N_EPISODES, N_EPISODES + 1]
        if "error" not in answer:
            assert answer["opened"] == N_EPISODES, story
            assert answer["counted"] in whole, story
            assert answer["saved"] in (None, N_EPISODES), story
            saved = int(answer["saved"] is not None)
    elif "error" not in answer:
        assert not answer.get("dropped"), story
        assert answer.get("kept", [[n, n] for n in range(N_EPISODES)]) == [[n, n] for n in range(N_EPISODES)], story
        assert answer.get("episodes", N_EPISODES) == N_EPISODES, story
        assert not answer.get("wrong"), story

    # Nothing was touched that need not be.
    assert neighbours(folder) == beside, story
    was_repaired = operation == "repair" and original.name == "killed" and "error" not in answer
    target = folder / "dataset_repaired"
    assert target.exists() == was_repaired, story
    if operation != "record":
        assert contents(root) == before, story

    # Without the fault every episode is there.
    if not was_repaired:
        report = repair_dataset(root)
        assert not report.dropped, f"{story}: {report}"
        assert (report.target is None) == (original.name == "ours"), f"{story}: {report}"
        target = report.target or root
    dataset = load(target)
    assert dataset.num_episodes in ((N_EPISODES, N_EPISODES + 1) if operation == "record" else (N_EPISODES,)), story
    assert dataset.num_episodes >= N_EPISODES + saved, story
    assert not differences(dataset, {n: n for n in range(dataset.num_episodes)}, RICH_FEATURES), story
    assert answer.get("counted", dataset.num_episodes) <= dataset.num_episodes, story
    assert not [path for path in folder.iterdir() if path.name.startswith((".dataset", ".playbyear"))], story
    return answer


def operations_of(name: str) -> tuple[str, ...]:
    return ("check", "repair") if name == "killed" else (*LOOKING, "repair", "record")


def meet_random_faults(disk: FaultyDisk, originals: dict[str, Path], folder: Path, seeds: range) -> None:
    calls: dict[tuple[str, str, int], int] = {}
    n_failed = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        name = ("ours", "ours", "killed")[seed % 3]
        operation = str(rng.choice(operations_of(name)))
        kinds = WRITES if operation in ("record", "repair") and rng.random() < 0.5 else READS
        known = (name, operation, kinds)
        if known not in calls:
            quiet = meet_fault(disk, originals[name], folder / f"{name} {operation} {kinds}", operation, kinds=kinds)
            assert "error" not in quiet, quiet
            calls[known] = quiet["calls"]
        error = int(rng.choice(ERRORS[kinds]))
        at = int(rng.integers(max(calls[known], 1)))
        answer = meet_fault(disk, originals[name], folder / str(seed), operation, at=at, error=error, kinds=kinds)
        n_failed += answer["failed"] is not None
        shutil.rmtree(folder / str(seed))
    assert n_failed >= 0.9 * len(seeds)  # some calls are made only now and then


@pytest.mark.slow
def test_whole_episodes_stay_wherever_a_disk_fails_for_a_moment(disk, originals, tmp_path):
    meet_random_faults(disk, originals, tmp_path, range(1000, 1100))
