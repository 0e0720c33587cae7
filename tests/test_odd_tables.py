"""Tables and metadata that are damaged in a part, or that a stranger wrote: the episodes behind them are kept."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_factory import CAMERA, MICROPHONE, make_dataset

from lerobot_playbyear.audio.attach import AttachAudioConfig, AttachError, DatasetPlace, attach_audio
from lerobot_playbyear.datasets import EpisodeStore, write_audio
from lerobot_playbyear.hub.dataset_card import describe_dataset
from lerobot_playbyear.inspection.source import DatasetSource

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
