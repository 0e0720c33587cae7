"""What looks wrong and is not proven: it is reported, and nobody's data is changed on a guess."""

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, TASK, make_dataset
from recording_factory import FILM, FPS, REPO_ID, RICH_FEATURES, TASKS, differences, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.repair import DatasetDamagedError, check_dataset, repair_dataset

LENGTHS = (6, 5, 7)
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TASKS_TABLE = "meta/tasks.parquet"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """With LeRobot: no checksums."""
    root = tmp_path_factory.mktemp("made") / "set"
    make_dataset(root, LENGTHS, image_size=16, use_videos=True)
    return root


@pytest.fixture
def root(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    """Of ours: a film per episode."""
    root = tmp_path_factory.mktemp("filmed") / "set"
    with DurableWriter(REPO_ID, root, FPS, RICH_FEATURES) as writer:
        for number in range(4):
            for frame in episode_frames(number, RICH_FEATURES):
                writer.add_frame(frame)
            writer.save_episode()
    return root


@pytest.fixture
def films(filmed, tmp_path) -> Path:
    return Path(shutil.copytree(filmed, tmp_path / "set"))


def change(path: Path, column: str, row: int, value: Any) -> None:
    table = pq.read_table(path)
    values = table.column(column).to_pylist()
    values[row] = value
    array = pa.array(values, table.schema.field(column).type)
    pq.write_table(table.set_column(table.column_names.index(column), column, array), path)


def everything(folder: Path) -> dict[Path, tuple[bytes, int]]:
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


def rename_task(root: Path, text: str) -> None:
    pd.DataFrame({"task_index": [0]}, index=pd.Index([text], name="task")).to_parquet(root / TASKS_TABLE)


@pytest.mark.parametrize("text", ["Grasp the hidden cubf.", "Take the cube."], ids=["one letter", "another name"])
def test_a_task_with_another_text_than_its_episodes_say_is_reported_and_stays(root, text):
    rename_task(root, text)
    before = everything(root)

    report = repair_dataset(root)

    assert report.is_sound
    assert len(report.odd) == 1
    assert f"task 0 reads {text!r}; the rows of episodes 0 to 2 in meta/episodes say {TASK!r}" in str(report)
    assert everything(root) == before


def test_a_lost_text_that_the_episodes_give_differently_is_not_voted_on(root):
    (root / TASKS_TABLE).unlink()
    change(root / EPISODES, "tasks", 2, ["Grasp the hidden cubf."])

    report = repair_dataset(root)

    assert f"the text of task 0 is lost: the episodes name it {TASK!r}, 'Grasp the hidden cubf.'" in str(report)
    assert pd.read_parquet(root / TASKS_TABLE).index.tolist() == ["unknown task 0"]
    rows = pq.read_table(root / EPISODES).column("tasks").to_pylist()
    assert rows == [[TASK], [TASK], ["Grasp the hidden cubf."]]


def test_a_task_that_has_no_text_is_for_a_person_to_decide(root):
    change(root / DATA, "task_index", 8, 5)
    (root / "meta/stats.json").unlink()
    before = everything(root)
    with pytest.raises(DatasetDamagedError, match="frames are of task 5, which has no text"):
        repair_dataset(root)
    assert everything(root) == before


def test_a_text_that_is_missing_in_the_table_is_taken_from_the_episodes_that_all_say_it(films):
    table = pd.read_parquet(films / TASKS_TABLE)
    table.iloc[:1].to_parquet(films / TASKS_TABLE)
    report = repair_dataset(films)
    assert f"the text of task 1 was missing; it is {TASKS[1]!r}" in str(report)
    assert not differences(load(films), {n: n for n in range(4)}, RICH_FEATURES)


def test_frames_with_a_wrong_number_in_the_dataset_are_kept_and_numbered_anew(root):
    change(root / DATA, "index", 8, 4000)
    report = repair_dataset(root)
    assert report.kept == {0: 0, 1: 1, 2: 2}
    assert "the frames of episode 1 are not numbered one after the other" in str(report)
    assert pq.read_table(root / DATA).column("index").to_pylist() == list(range(sum(LENGTHS)))


@pytest.mark.parametrize("column", ["length", "dataset_to_index"])
def test_an_episode_whose_row_counts_its_frames_in_two_ways_is_not_called_cut_off(root, column):
    known = pq.read_table(root / EPISODES).column(column)[1].as_py()
    change(root / EPISODES, column, 1, known + 64)
    report = repair_dataset(root)
    assert report.kept == {0: 0, 1: 1, 2: 2}
    assert "the row of episode 1 was wrong" in str(report)
    assert pq.read_table(root / EPISODES).column(column)[1].as_py() == known


def test_a_number_that_no_episode_has_drops_none(root):
    change(root / DATA, "episode_index", 6, 2**40)
    before = everything(root)
    report = check_dataset(root)
    assert f"there is no episode {2**40}, though a row names it in {DATA}" in str(report)
    with pytest.raises(DatasetDamagedError, match="nothing is repaired before you decide it"):
        repair_dataset(root)
    assert everything(root) == before


def test_pictures_that_are_not_where_a_row_says_in_two_ways_are_not_called_lost(root):
    change(root / EPISODES, f"videos/{CAMERA}/from_timestamp", 2, 64.0)
    before = everything(root)
    report = repair_dataset(root)
    assert not report.dropped
    assert f"where the pictures of '{CAMERA}' of episode 2 are" in report.undecided[0]
    assert everything(root) == before


def test_no_episode_gets_the_pictures_of_another(films):
    """The rows that say where they are lost, and one film: the next film is as good as the one that is gone."""
    shutil.rmtree(films / "meta/episodes")
    sorted((films / "videos" / FILM).glob("*/*"))[1].unlink()
    before = everything(films)
    with pytest.raises(DatasetDamagedError, match=f"where the pictures of '{FILM}' of episodes 0 to 3 are") as error:
        repair_dataset(films)
    assert "file-002.mp4" in str(error.value)
    assert everything(films) == before


def test_an_episode_whose_film_and_place_are_lost_does_not_take_the_next_ones(films):
    place = f"videos/{FILM}/file_index"
    files = pq.read_table(films / EPISODES).column(place).to_pylist()
    change(films / EPISODES, f"videos/{FILM}/from_timestamp", 2, float("nan"))
    sorted((films / "videos" / FILM).glob("*/*"))[2].unlink()
    report = repair_dataset(films)
    assert report.kept == {0: 0, 1: 1, 3: 2}
    assert pq.read_table(films / EPISODES).column(place).to_pylist() == [files[0], files[1], files[3]]
    assert not differences(load(films), {0: 0, 1: 1, 2: 3}, RICH_FEATURES)


def test_a_correction_by_hand_makes_the_repair_go_on(root):
    (root / "meta/stats.json").unlink()
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | {"fps": 50}))
    with pytest.raises(DatasetDamagedError, match="Write 20 there if they are right"):
        repair_dataset(root)
    path.write_text(json.dumps(info))
    assert repair_dataset(root).changed
