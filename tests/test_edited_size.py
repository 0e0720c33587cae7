"""What `lerobot-edit-dataset` does to the sound of a dataset that we wrote: nothing but its size on the disk."""

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_edit_dataset

from lerobot_playbyear.datasets import audio_feature, episode_waveform
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.survey import survey

KEY = "observation.audio.gripper"
FEATURES = {KEY: audio_feature(16000, 20), "action": {"dtype": "float32", "shape": (1,), "names": None}}


def write(root: Path, **options) -> None:
    """Two more episodes of a quiet room."""
    rng = np.random.default_rng(0)
    with DurableWriter("tests/quiet", root, 20, FEATURES, **options) as writer:
        for _ in range(2):
            for _ in range(30):
                sound = rng.normal(0, 20, 800).astype(np.int16)
                writer.add_frame({KEY: sound, "action": np.zeros(1, np.float32), "task": "Listen."})
            writer.save_episode()


def sound_on_disk(root: Path) -> tuple[float, bool]:
    """Bytes of a sample, and whether all of them are stored as differences."""
    groups = [
        metadata.row_group(i)
        for path in root.glob("data/*/*.parquet")
        for metadata in [pq.ParquetFile(path).metadata]
        for i in range(metadata.num_row_groups)
    ]
    columns = [group.column(i) for group in groups for i in range(group.num_columns)]
    sound = [column for column in columns if column.path_in_schema.startswith(KEY)]
    n_bytes = sum(column.total_compressed_size for column in sound)
    return n_bytes / sum(column.num_values for column in sound), all(
        "DELTA_BINARY_PACKED" in column.encodings for column in sound
    )


def waveform(root: Path, episode: int) -> np.ndarray:
    return episode_waveform(LeRobotDataset("tests/quiet", root=root, video_backend="pyav"), episode, KEY)[0]


def test_deleting_episodes_costs_bytes_and_no_sample(tmp_path, monkeypatch):
    write(tmp_path / "ours")
    options = ["--operation.type=delete_episodes", "--operation.episode_indices=[0]"]
    roots = ["--repo_id=tests/quiet", f"--root={tmp_path / 'ours'}", "--new_repo_id=tests/left"]
    monkeypatch.setattr(sys, "argv", ["edit", *roots, f"--new_root={tmp_path / 'left'}", *options])
    lerobot_edit_dataset.main()

    kept = waveform(tmp_path / "ours", 1)
    np.testing.assert_array_equal(waveform(tmp_path / "left", 0), kept)
    assert survey(tmp_path / "left").is_sound
    (before, is_ours), (after, is_theirs) = sound_on_disk(tmp_path / "ours"), sound_on_disk(tmp_path / "left")
    assert (is_ours, is_theirs) == (True, False)
    assert before < 1.1
    assert after < 1.2 * before, "more than docs/dataset.md says"

    write(tmp_path / "left", resume=True)  # a data file that is continued is written anew
    np.testing.assert_array_equal(waveform(tmp_path / "left", 0), kept)
    bytes_again, is_ours_again = sound_on_disk(tmp_path / "left")
    assert is_ours_again
    assert bytes_again < 1.1
