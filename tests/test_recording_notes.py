"""What a robot's recording says about itself."""

import json

import numpy as np
from dataset_factory import make_dataset

from lerobot_playbyear.datasets.episode_clock import CLOCK_PATH
from lerobot_playbyear.datasets.recording_notes import NOTES_PATH, note_recording, recording_notes, renumber_notes
from lerobot_playbyear.inspection.recording_checks import check_recording
from lerobot_playbyear.inspection.source import DatasetSource

FACTS = {"begun_at_s": 1.75e9, "ticks": 100, "late_ticks": 0, "drop_outs": {"gripper": []}}


def test_notes_survive_a_torn_line_and_strange_ones(tmp_path):
    (tmp_path / "meta").mkdir()
    note_recording(tmp_path, 0, FACTS)
    with (tmp_path / NOTES_PATH).open("ab") as file:
        file.write(b'{"episode": 1, "ti')
    note_recording(tmp_path, 1, FACTS | {"ticks": 7})
    with (tmp_path / NOTES_PATH).open("ab") as file:
        file.write(b'[]\n{"episode": "x"}\n\xff\xfe\n' + b"[" * 100000 + b"\n")
    notes = recording_notes(tmp_path)
    assert {index: note["ticks"] for index, note in notes.items()} == {0: 100, 1: 7}
    assert json.loads((tmp_path / CLOCK_PATH).read_text())["episodes"] == {"0": 1.75e9, "1": 1.75e9}


def test_notes_follow_their_episodes(tmp_path):
    (tmp_path / "meta").mkdir()
    for index in range(3):
        note_recording(tmp_path, index, FACTS | {"ticks": index})
    assert renumber_notes(tmp_path, {0: 0, 1: 1, 2: 2}) is None
    assert "2 episodes" in renumber_notes(tmp_path, {0: 0, 2: 1})
    assert {index: note["ticks"] for index, note in recording_notes(tmp_path).items()} == {0: 0, 1: 2}


def test_a_folder_that_cannot_be_written_costs_no_episode(tmp_path, caplog):
    note_recording(tmp_path / "nothing", 0, FACTS)
    assert "is not noted" in caplog.text
    assert recording_notes(tmp_path / "nothing") == {}


def test_inspect_tells_of_drop_outs_and_late_ticks(tmp_path):
    root = tmp_path / "data"
    make_dataset(root)
    source = DatasetSource.open("me/data", str(root), None, "pyav")
    assert list(check_recording(source)) == []
    for index in range(3):
        note_recording(root, index, FACTS)
    assert [verdict.level for verdict in check_recording(source)] == ["ok", "ok"]
    drops = {"left": [[3, 400, "lost"]], "right": [[3, 400, "lost"]]}
    note_recording(root, 1, FACTS | {"drop_outs": drops, "late_ticks": 90})
    drop_outs, ticks = check_recording(source)
    assert drop_outs.level == ticks.level == "warning"
    assert list(drop_outs.episodes) == [1]
    assert drop_outs.message.startswith("1 place without")
    assert ticks.figures == {"ticks": 300, "late": 90}
    note_recording(root, 1, {"drop_outs": np.inf, "ticks": "many", "late_ticks": -3})
    assert [verdict.level for verdict in check_recording(source)] == ["ok", "ok"]
