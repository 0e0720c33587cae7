"""Tables and metadata that are damaged in a part, or that a stranger wrote: the episodes behind them are kept."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, MICROPHONE, make_dataset
from PIL import Image

from lerobot_playbyear.audio.attach import AttachAudioConfig, AttachError, DatasetPlace, attach_audio
from lerobot_playbyear.datasets import EpisodeStore, write_audio
from lerobot_playbyear.datasets.repair import DatasetDamagedError, check_dataset, repair_dataset
from lerobot_playbyear.hub.dataset_card import describe_dataset
from lerobot_playbyear.inspection.source import DatasetSource
from lerobot_playbyear.scripts.repair import main as repair_command

LENGTHS = (6, 5, 7)
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
PLACES = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("made") / "set"
    make_dataset(root, LENGTHS, image_size=16)
    return root


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("filmed") / "set"
    make_dataset(root, LENGTHS, image_size=16, use_videos=True)
    return root


@pytest.fixture
def root(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


@pytest.fixture
def videos(filmed, tmp_path) -> Path:
    return Path(shutil.copytree(filmed, tmp_path / "set"))


def change(path: Path, column: str, values: list) -> None:
    """Puts other values into a column, of the column's type where they can be."""
    table = pq.read_table(path)
    kind = table.schema.field(column).type
    try:
        array = pa.array(values, kind)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        array = pa.array(values)
    pq.write_table(table.set_column(table.column_names.index(column), column, array), path)


def change_info(root: Path, **fields) -> None:
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def spoil_column(path: Path, column: str) -> None:
    """Flips the last byte of a column's page, which has a checksum."""
    pq.write_table(pq.read_table(path), path, write_page_checksum=True, use_dictionary=False)
    group = pq.read_metadata(path).row_group(0)
    chunks = {group.column(i).path_in_schema: group.column(i) for i in range(group.num_columns)}
    data = bytearray(path.read_bytes())
    data[chunks[column].data_page_offset + chunks[column].total_compressed_size - 1] ^= 0xFF
    path.write_bytes(data)


def sound_files(tmp_path: Path) -> str:
    for episode in range(len(LENGTHS)):
        write_audio(tmp_path / f"{episode}.wav", np.zeros(16000, np.int16), 16000)
    return str(tmp_path / "{episode}.wav")


def attach(root: Path, tmp_path: Path) -> Path:
    places = DatasetPlace("a/b", str(root)), DatasetPlace("a/c", str(tmp_path / "copy"))
    return attach_audio(AttachAudioConfig(*places, files=sound_files(tmp_path), microphone="new"))


@pytest.mark.parametrize("name", PLACES)
def test_a_row_that_has_lost_a_part_of_a_videos_place_is_made_anew(videos, name):
    spoil_column(videos / EPISODES, f"videos/{CAMERA}/{name}")
    report = repair_dataset(videos)
    assert len(report.kept) == len(LENGTHS)
    assert "the rows of episodes 0 to 2 were lost" in str(report)
    assert EpisodeStore.load("a/b", str(videos), video_backend="pyav").n_episodes == len(LENGTHS)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0])
@pytest.mark.parametrize("name", PLACES)
def test_an_episode_is_not_lost_to_a_number_that_is_no_place(videos, name, value):
    known = pq.read_table(videos / EPISODES).column(f"videos/{CAMERA}/{name}").to_pylist()
    change(videos / EPISODES, f"videos/{CAMERA}/{name}", [known[0], value, float(known[2])])
    report = repair_dataset(videos)
    assert len(report.kept) == len(LENGTHS)
    assert "the row of episode 1 was wrong: it does not say where the video" in str(report)


@pytest.mark.parametrize("field", ["{nope}", "{}", "{chunk_index.x}", "{chunk_index:>99999999999}"])
@pytest.mark.parametrize("path", ["data_path", "video_path"])
def test_a_template_that_cannot_be_filled_in_is_replaced(videos, path, field):
    template = json.loads((videos / "meta/info.json").read_text())[path]
    change_info(videos, **{path: template.replace("{chunk_index:03d}", field).replace("chunk-", "")})
    report = repair_dataset(videos)
    assert len(report.kept) == len(LENGTHS)
    assert json.loads((videos / "meta/info.json").read_text())[path] == template


@pytest.mark.parametrize("field", ["{nope}", "{}", "{chunk_index.x}", "{chunk_index:>99999999999}"])
@pytest.mark.parametrize("path", ["data_path", "video_path"])
def test_a_template_that_nothing_fits_is_for_a_person_to_decide(videos, path, field):
    change_info(videos, **{path: f"{path}/{field}.mp4"})
    shutil.move(videos / path.removesuffix("_path").replace("video", "videos"), videos.parent / "elsewhere")
    report = check_dataset(videos)
    assert f"{path} was '{path}/{field}.mp4', where nothing is, nor at" in report.undecided[0]
    with pytest.raises(DatasetDamagedError):
        repair_dataset(videos)


@pytest.mark.parametrize("values", [[[1.0] * 4, [None] * 4, [1.0] * 4], [[1.0] * 4, None, [1.0] * 4], ["x", "y", "z"]])
def test_a_row_whose_statistics_are_no_numbers_is_made_anew(root, values):
    change(root / EPISODES, "stats/action/mean", values)
    report = repair_dataset(root)
    assert len(report.kept) == len(LENGTHS)
    assert re.search("the row of episode 1 was wrong: (parts of )?its statistics", str(report))


def test_statistics_of_one_number_move_with_their_episode(root):
    table = pq.read_table(root / EPISODES)
    change(root / EPISODES, "stats/index/min", [row[0] for row in table.column("stats/index/min").to_pylist()])
    pictures = pq.read_table(root / DATA).column(CAMERA).to_pylist()
    change(root / DATA, CAMERA, [{"bytes": b"damaged", "path": None}, *pictures[1:]])
    assert repair_dataset(root).kept == {1: 0, 2: 1}
    assert pq.read_table(root / EPISODES).column("stats/index/min").to_pylist() == [0, 5]


def test_splits_that_are_none_stop_no_repair(root):
    change_info(root, splits=[1])
    (root / "meta/tasks.parquet").unlink()
    assert len(repair_dataset(root).kept) == len(LENGTHS)


def test_rows_without_a_number_cost_only_their_own_episode(root):
    table = pq.read_table(root / DATA)
    numbers = np.array(table.column("episode_index"))
    with pq.ParquetWriter(root / DATA, table.schema) as writer:
        for episode in range(len(LENGTHS)):
            part = table.filter(pa.array(numbers == episode))
            if episode == 1:
                kind = part.schema.field("frame_index").type
                place = part.column_names.index("frame_index")
                part = part.set_column(place, "frame_index", pa.array([0, None, 2, 3, 4], kind))
            writer.write_table(part)
    report = repair_dataset(root)
    assert report.kept == {0: 0, 2: 1}
    store = EpisodeStore.load("a/b", str(root))
    assert [end - start for start, end in zip(store.starts, store.ends, strict=True)] == [6, 7]


def test_a_row_is_made_anew_of_pictures_in_files(root):
    Image.new("RGB", (16, 16), (9, 8, 7)).save(root / "picture.png")
    change(root / DATA, CAMERA, [{"bytes": None, "path": "picture.png"}] * sum(LENGTHS))
    (root / EPISODES).write_bytes(b"lost")
    assert len(repair_dataset(root).kept) == len(LENGTHS)
    assert np.allclose(
        np.ravel(pq.read_table(root / EPISODES).column(f"stats/{CAMERA}/max")[0].as_py()) * 255, [9, 8, 7]
    )


def test_a_repair_reads_no_picture_outside_the_folder(root, tmp_path):
    Image.new("RGB", (16, 16)).save(tmp_path / "private.png")
    change(root / DATA, CAMERA, [{"bytes": None, "path": "../private.png"}] * sum(LENGTHS))
    (root / EPISODES).write_bytes(b"lost")
    with pytest.raises(ValueError, match="outside its folder"):
        repair_dataset(root)


@pytest.mark.parametrize("column", ["stats/action/mean.list.element", "length"])
def test_sound_is_attached_to_no_damaged_table(root, tmp_path, column):
    spoil_column(root / EPISODES, column)
    with pytest.raises(AttachError, match=r"file-000\.parquet.*playbyear-repair --root="):
        attach(root, tmp_path)
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize("what", ["more frames", "no number"])
def test_sound_is_attached_to_no_rows_that_the_tables_do_not_name(root, tmp_path, what):
    episodes, frames = (pq.read_table(root / DATA).column(f"{name}_index").to_pylist() for name in ("episode", "frame"))
    if what == "more frames":
        change(root / DATA, "episode_index", [*episodes[:-1], 1])
        change(root / DATA, "frame_index", [*frames[:-1], 5])
    else:
        change(root / DATA, "frame_index", [None, *frames[1:]])
    with pytest.raises(AttachError, match=r"file-000\.parquet.*playbyear-repair --root="):
        attach(root, tmp_path)
    assert not (tmp_path / "copy").exists()


def test_a_picture_that_is_missing_is_named(root):
    pictures = pq.read_table(root / DATA).column(CAMERA).to_pylist()
    change(root / DATA, CAMERA, [*pictures[:3], None, *pictures[4:]])
    with pytest.raises(ValueError, match=f"'{CAMERA}': a picture is missing"):
        EpisodeStore.load("a/b", str(root))


def test_a_card_shows_a_sample_rate_that_is_none(root):
    features = json.loads((root / "meta/info.json").read_text())["features"]
    features[MICROPHONE]["info"]["sample_rate"] = "<b>abc"
    change_info(root, features=features)
    card = describe_dataset(DatasetSource.open("a/b", root), "a/b", None, None)
    assert "abc" in card
    assert "<b>" not in card


@pytest.mark.parametrize("text", ["[]", "{}", '{"features": 1}', "{"])
def test_a_model_for_a_repair_that_is_none_is_told(root, tmp_path, monkeypatch, text):
    (tmp_path / "like/meta").mkdir(parents=True)
    (tmp_path / "like/meta/info.json").write_text(text)
    monkeypatch.setattr("sys.argv", ["playbyear-repair", f"--root={root}", f"--like={tmp_path / 'like'}"])
    with pytest.raises(SystemExit, match=r"error: --like=.*info\.json"):
        repair_command()
