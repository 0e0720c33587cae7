"""Only what is proven is damage: what cannot be read now, or is read differently each time, changes nothing."""

import os
import shutil
import signal
import sys
from pathlib import Path

import pyarrow as pa
import pytest
from recording_factory import FEATURES, FPS, REPO_ID, episode_frames

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.files import is_listed, list_files
from lerobot_playbyear.datasets.info import check_dataset_files
from lerobot_playbyear.datasets.parquet import ParquetDamageError, open_checked, parsing, read_table
from lerobot_playbyear.datasets.repair import check_dataset, repair_dataset, repairing
from lerobot_playbyear.datasets.repair.rescue import rescue
from lerobot_playbyear.datasets.repair.video_times import picture_times
from lerobot_playbyear.inspection.damage import find_damage
from lerobot_playbyear.scripts import repair as repair_command

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    with DurableWriter(REPO_ID, root, FPS, FEATURES) as writer:
        for number in range(2):
            for frame in episode_frames(number, FEATURES):
                writer.add_frame(frame)
            writer.save_episode()
    return root


@pytest.fixture
def root(recorded, tmp_path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "dataset"))


def test_files_that_appear_while_a_dataset_is_looked_at_were_not_lost(root, monkeypatch):
    """As those of a copy that is still on its way, or on a network's disk that is behind."""
    data = (root / DATA).read_bytes()
    look = repairing.fingerprint

    def arrive(folder):
        (root / DATA).write_bytes(data)
        return look(folder)

    monkeypatch.setattr(repairing, "fingerprint", arrive)  # what is done between the first look and the second
    (root / DATA).write_bytes(data[: len(data) // 2])
    with pytest.raises(OSError, match="what is read changes"):
        repair_dataset(root)
    (root / DATA).unlink()
    monkeypatch.setattr(sys, "argv", ["playbyear-repair", f"--root={root}"])
    with pytest.raises(SystemExit, match=r"(?s)what is read changes.*Nothing was changed.*is no damage"):
        repair_command.main()
    assert check_dataset(root).is_sound
    assert [path.name for path in root.parent.iterdir()] == ["dataset"]


@pytest.mark.parametrize("name", [DATA, "meta/info.json", "meta/tasks.parquet", "meta/stats.json", "meta/episodes"])
def test_a_file_that_is_listed_and_cannot_be_opened_is_not_missing(root, name):
    """A link to a disk that is not there at the moment stands for what no superuser can open."""
    path = root / name
    path.rename(root.parent / "elsewhere")
    path.symlink_to(root.parent / "elsewhere")
    assert check_dataset(root).is_sound
    (root.parent / "elsewhere").rename(root.parent / "not there")

    with pytest.raises(FileNotFoundError) as error:
        repair_dataset(root)

    assert error.value.filename is not None
    assert path.is_symlink()
    assert sorted(path.name for path in root.parent.iterdir()) == ["dataset", "not there"]
    if name != "meta/info.json":
        assert "cannot be read now" in str(find_damage(root))


def test_a_table_that_cannot_be_read_now_is_not_called_damaged(root):
    (root / DATA).unlink()
    (root / DATA).mkdir()  # a folder opens, but cannot be read
    for read in (open_checked, read_table):
        with pytest.raises(IsADirectoryError):
            read(root / DATA)
    with pytest.raises(OSError, match=r"file-000\.parquet"):
        check_dataset_files(REPO_ID, root)


def test_a_lack_of_memory_is_no_damage_and_a_misread_size_is(tmp_path):
    path = tmp_path / "file.parquet"
    path.write_bytes(bytes(1000))
    with pytest.raises(MemoryError), parsing(path):
        raise pa.ArrowMemoryError("malloc of size 500000000 failed")
    with pytest.raises(MemoryError), parsing(path):
        raise MemoryError
    with pytest.raises(ParquetDamageError, match="failed"), parsing(path):
        pa.allocate_buffer(2**60)


def test_bytes_that_nest_without_end_are_no_pages(tmp_path):
    path = tmp_path / "file.parquet"
    path.write_bytes(b"PAR1" + b"\x19" * 60_000)  # a list with a list with a list
    assert rescue(path, pa.schema([("index", pa.int64())])) is None


@pytest.mark.skipif(os.name == "nt", reason="a shell script stands for the decoder's process")
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV])
def test_only_a_crash_of_the_decoder_is_laid_to_the_film(tmp_path, monkeypatch, ending):
    """The kernel kills processes where memory is short."""
    decoder = tmp_path / "decoder"
    decoder.write_text(f"#!/bin/sh\nkill -{ending.value} $$\n")
    decoder.chmod(0o755)
    (tmp_path / "film.mp4").touch()
    monkeypatch.setattr(sys, "executable", str(decoder))
    if ending == signal.SIGSEGV:
        assert picture_times([Path("film.mp4")], tmp_path) == {Path("film.mp4"): "it makes the decoder crash"}
    else:
        with pytest.raises(ChildProcessError, match="memory is short"):
            picture_times([Path("film.mp4")], tmp_path)


def test_what_is_missing_is_what_no_folder_lists(tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/[1].txt").touch()
    (tmp_path / "a/file").touch()
    (tmp_path / "a/gone").symlink_to(tmp_path / "nowhere")
    assert is_listed(tmp_path, "a/b/[1].txt")
    assert is_listed(tmp_path, "a/gone")
    assert not is_listed(tmp_path, "a/b/1.txt")
    assert not is_listed(tmp_path, "a/c/x.txt")
    assert not is_listed(tmp_path, "../" + tmp_path.name)
    assert not is_listed(tmp_path, tmp_path.as_posix())
    assert list_files(tmp_path, "a/b/*") == [tmp_path / "a/b/[1].txt"]
    with pytest.raises(FileNotFoundError):
        list_files(tmp_path, "a/*/*")
