"""What a repair keeps of a dataset's metadata: everything that is right, and what it makes anew it names."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, INFO_PATH, STATS_PATH
from recording_factory import FEATURES, FPS, REPO_ID, differences, episode_frames, load

from lerobot_playbyear.datasets import settling
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.repair import RepairReport, check_dataset, repair_dataset

N_EPISODES = 6
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A dataset of a data file per episode."""
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    with (
        pytest.MonkeyPatch.context() as patch,
        DurableWriter(REPO_ID, root, FPS, FEATURES, robot_type="arm") as writer,
    ):
        patch.setattr(settling, "_SMALL_DATA_BYTES", 0)
        for number in range(N_EPISODES):
            for frame in episode_frames(number, FEATURES):
                writer.add_frame(frame)
            writer.save_episode()
    return root


@pytest.fixture
def root(recorded, tmp_path) -> Path:
    """The dataset, with all that tools and people add to one."""
    root = Path(shutil.copytree(recorded, tmp_path / "dataset"))
    info = json.loads((root / INFO_PATH).read_text())
    info |= {"splits": {"train": "0:4", "val": "4:6"}, "licence": "CC-BY", "total_videos": 0}
    info["features"]["action"]["unit"] = "metre"
    (root / INFO_PATH).write_text(json.dumps(info, indent=4))
    stats = json.loads((root / STATS_PATH).read_text())
    stats["action"]["min"], stats["action"]["max"] = [-9.0] * 4, [9.0] * 4
    stats["force"] = {"mean": [1.0], "count": [30]}
    (root / STATS_PATH).write_text(json.dumps(stats))
    tasks = pd.read_parquet(root / DEFAULT_TASKS_PATH)
    tasks["difficulty"] = ["easy", "hard"]
    tasks.to_parquet(root / DEFAULT_TASKS_PATH)
    rows = pq.read_table(root / EPISODES)
    rows = rows.append_column("operator", pa.array([f"person {n}" for n in range(N_EPISODES)]))
    pq.write_table(rows.append_column("score", pa.array([None] * N_EPISODES, pa.float32())), root / EPISODES)
    for name in ("meta/calibration/left.json", "meta/modality.json", "README.md", "notes/day 1.txt", "data/source.txt"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name)
    (root / "images/plot.png").parent.mkdir(exist_ok=True)
    (root / "images/plot.png").write_bytes(b"of the user's own")
    assert check_dataset(root).is_sound
    return root


def files(root: Path) -> dict[str, bytes]:
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def read(root: Path, name: str) -> dict[str, Any]:
    return json.loads((root / name).read_text())


def all_said(report: RepairReport) -> str:
    assert all(line in str(report) for line in report.remade)
    return "\n".join(report.remade)


def test_a_missing_table_of_tasks_takes_nothing_else_with_it(root):
    before = files(root)
    del before[DEFAULT_TASKS_PATH]
    (root / DEFAULT_TASKS_PATH).unlink()

    report = repair_dataset(root)

    after = files(root)
    assert {name: after.get(name) for name in before} == before | {INFO_PATH: after[INFO_PATH]}
    assert set(after) == {*before, DEFAULT_TASKS_PATH}
    assert read(root, INFO_PATH) == json.loads(before[INFO_PATH])
    assert f"{DEFAULT_TASKS_PATH}: made anew from the episodes; what it held that no episode says is lost" in str(
        report
    )
    assert len(report.remade) == 1
    assert not differences(load(root), {n: n for n in range(N_EPISODES)}, FEATURES)


def test_a_lost_episode_leaves_the_rest_of_the_metadata_as_it_was(root):
    before = files(root)
    sorted(root.glob("data/*/*"))[4].unlink()  # frames of episode 4, the first of `val`

    report = repair_dataset(root)

    assert list(report.dropped) == [4]
    info, old = read(root, INFO_PATH), json.loads(before[INFO_PATH])
    changed = {"splits": {"train": "0:4", "val": "4:5"}, "total_episodes": 5, "total_frames": info["total_frames"]}
    assert info == {**old, **changed}
    assert "the split 'val' was 4:6; in the episodes' new numbers it is 4:5" in all_said(report)
    for name in ("meta/calibration/left.json", "meta/modality.json", "README.md", "notes/day 1.txt", "data/source.txt"):
        assert (root / name).read_text() == name
    assert (root / "images/plot.png").read_bytes() == before["images/plot.png"]
    assert (root / DEFAULT_TASKS_PATH).read_bytes() == before[DEFAULT_TASKS_PATH]
    rows = pq.read_table(root / EPISODES)
    assert rows.column("operator").to_pylist() == [f"person {n}" for n in (0, 1, 2, 3, 5)]
    assert rows.schema.field("score").type == pa.float32()
    assert "meta/episodes: made anew, as one table" in all_said(report)


def test_statistics_that_were_set_by_hand_stay_and_are_named(root):
    sorted(root.glob("data/*/*"))[0].unlink()

    report = repair_dataset(root)

    stats = read(root, STATS_PATH)
    assert (stats["action"]["min"], stats["action"]["max"]) == ([-9.0] * 4, [9.0] * 4)
    assert stats["force"] == {"mean": [1.0], "count": [30]}
    frames = [frame["action"] for n in range(1, N_EPISODES) for frame in episode_frames(n, FEATURES)]
    np.testing.assert_allclose(stats["action"]["mean"], np.mean(frames, axis=0), atol=1e-5)
    assert stats["action"]["count"] == [len(frames)]
    assert f"{STATS_PATH}: made anew from the episodes: " in all_said(report)
    for named in ("min of 'action'", "max of 'action'", "'force'"):
        assert named in all_said(report).split("as they were: ")[1]


def test_one_wrong_entry_of_the_statistics_leaves_the_others(root):
    stats = read(root, STATS_PATH)
    right = stats["timestamp"]
    (root / STATS_PATH).write_text(json.dumps({**stats, "timestamp": {"mean": ["x"]}}))

    report = repair_dataset(root)

    again = read(root, STATS_PATH)
    assert {key: own for key, own in again.items() if key != "timestamp"} == {
        key: own for key, own in stats.items() if key != "timestamp"
    }
    np.testing.assert_allclose(again["timestamp"]["mean"], right["mean"])
    assert f"{STATS_PATH}: made anew from the episodes: timestamp" in all_said(report)


def test_a_dataset_whose_features_are_lost_keeps_its_other_fields(root):
    info = read(root, INFO_PATH)
    del info["features"]["frame_index"]
    (root / INFO_PATH).write_text(json.dumps(info))

    report = repair_dataset(root, fps=FPS, features=FEATURES)

    after = read(root, INFO_PATH)
    assert after["licence"] == "CC-BY"
    assert after["robot_type"] == "arm"
    assert after["splits"] == {"train": "0:4", "val": "4:6"}
    assert "robot_type, splits and all other fields are those that it had" in str(report)


def test_what_an_unreadable_info_held_is_said_to_be_lost(root):
    (root / INFO_PATH).write_text("{")
    report = repair_dataset(root, fps=FPS, features=FEATURES)
    assert "robot_type, splits, and what else it held besides them, is lost" in str(report)


def test_pictures_of_an_episode_in_progress_stay_behind_and_are_named(root):
    leftover = root / "images/observation.images.front/episode-000006/frame-000000.png"
    leftover.parent.mkdir(parents=True)
    leftover.write_bytes(b"not saved")
    (root / DEFAULT_TASKS_PATH).unlink()

    report = repair_dataset(root)

    assert not leftover.exists()
    assert (report.original / leftover.relative_to(root)).read_bytes() == b"not saved"
    assert "pictures of an episode that was not saved stay behind" in all_said(report)


def test_the_ordinary_split_grows_and_shrinks_with_the_dataset(recorded, tmp_path):
    root = Path(shutil.copytree(recorded, tmp_path / "dataset"))
    sorted(root.glob("data/*/*"))[2].unlink()
    report = repair_dataset(root)
    assert read(root, INFO_PATH)["splits"] == {"train": "0:5"}
    assert "split" not in all_said(report)
