"""Resuming finishes what a writer of ours had begun; all else that is wrong is said, with what to do, and left alone."""

import contextlib
import errno
import json
import os
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from lerobot.configs.video import RGBEncoderConfig
from recording_factory import FEATURES, FPS, REPO_ID, differences, episode_frames, load

from lerobot_playbyear.datasets import episode_files
from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter, has_dataset
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.survey import DatasetDamagedError
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.repair import repair_dataset

N_EPISODES = 4


def writer(root: Path) -> DurableWriter:
    encoder = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
    return DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True, rgb_encoder=encoder)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """Each episode in a file of its own."""
    root = tmp_path_factory.mktemp("original") / "dataset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode_files, "SMALL_DATA_BYTES", 0)
        with writer(root) as target:
            for number in range(N_EPISODES):
                for frame in episode_frames(number, FEATURES):
                    target.add_frame(frame)
                target.save_episode()
    return root


@pytest.fixture
def root(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "parent" / "dataset"))


def everything(folder: Path) -> dict[Path, tuple[bytes, int]]:
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.rglob("*") if path.is_file()}


def data_files(root: Path) -> list[Path]:
    return sorted(root.glob("data/*/*.parquet"))


def not_synchronised(path: Path) -> None:
    """As a power cut leaves what was written and not synchronised: the size is there, and no content."""
    path.write_bytes(bytes(path.stat().st_size))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(("how", "which"), [(not_synchronised, (1,)), (cut, (2, 3)), (Path.unlink, (1, 2))])
def test_episodes_whose_files_are_damaged_are_not_dropped(root, how, which):
    for path in [data_files(root)[number] for number in which]:
        how(path)
    before = everything(root.parent)

    with pytest.raises(DatasetDamagedError, match=rf"playbyear-repair --root='?{root}") as error:
        writer(root)

    assert "othing was changed" in str(error.value)
    assert everything(root.parent) == before
    assert {path.name for path in root.parent.iterdir()} == {"dataset"}
    assert {path.name for path in root.iterdir()} == {"data", "meta", "images"}
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


@pytest.mark.parametrize("victim", ["meta/stats.json", "meta/tasks.parquet", "meta/info.json"])
def test_tables_that_are_lost_are_not_made_anew_in_passing(root, victim):
    (root / victim).unlink()
    before = everything(root.parent)
    with pytest.raises(DatasetDamagedError, match="repair"):
        writer(root)
    assert everything(root.parent) == before


@pytest.mark.parametrize("name", ["data_path", "video_path"])
def test_files_are_not_written_to_where_a_stranger_wants_them(root, name):
    """A path that leads out of the dataset and back in again: it can be read, and would be written to elsewhere."""
    info = json.loads((root / "meta/info.json").read_text())
    info[name] = "../dataset/data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    (root / "meta/info.json").write_text(json.dumps(info))
    before = everything(root.parent)
    with pytest.raises(DatasetDamagedError):
        writer(root)
    assert everything(root.parent) == before


def test_the_command_that_is_named_makes_it_good(root):
    cut(data_files(root)[1])
    with pytest.raises(DatasetDamagedError):
        writer(root)
    root = repair_dataset(root).target
    with writer(root) as target:
        assert target.num_episodes == N_EPISODES - 1
    assert not differences(load(root), {0: 0, 1: 2, 2: 3}, FEATURES)


@pytest.mark.parametrize(("code", "after"), [(errno.ESTALE, 0), (errno.EIO, 2), (errno.ENOMEM, 3)])
def test_a_read_that_failed_once_costs_no_episode(root, monkeypatch, code, after):
    """An error of the network or the disk while a data file is read; then it can be read again."""
    real, calls = pq.ParquetFile.read_row_group, iter(range(1000))

    def read_row_group(*args, **kwargs):
        if next(calls) == after:
            raise OSError(code, os.strerror(code))
        return real(*args, **kwargs)

    before = everything(root.parent)
    with monkeypatch.context() as patch:
        patch.setattr(pq.ParquetFile, "read_row_group", read_row_group)
        with contextlib.suppress(DatasetWriteError, DatasetDamagedError):  # or it reads once more, and finds all well
            writer(root).close()
    assert everything(root.parent) == before
    with writer(root) as target:
        assert target.num_episodes == N_EPISODES
    assert not differences(load(root), {n: n for n in range(N_EPISODES)}, FEATURES)


@pytest.mark.parametrize("what", ["parent", "data"])
def test_a_folder_that_cannot_be_listed_is_not_empty(tmp_path, what):
    """Only the names in it tell that it holds a dataset: its metadata are lost."""
    if os.geteuid() != 0:
        pytest.skip("takes root, which becomes somebody else")
    root = tmp_path / "dataset"
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "data/chunk-000/file-000.parquet").touch()
    assert has_dataset(root)
    for path in [root, *root.parents]:
        if str(path).startswith(str(root.parents[2])):
            path.chmod(0o777)
    (root.parent if what == "parent" else root / "data").chmod(0)
    os.seteuid(65534)
    try:
        with pytest.raises(PermissionError):
            has_dataset(root)
        with pytest.raises(DatasetWriteError, match="Permission denied"):
            writer(root)
    finally:
        os.seteuid(0)
        root.parent.chmod(0o755)
        (root / "data").chmod(0o755)
    assert [path.name for path in root.iterdir()] == ["data"]


def test_the_recording_command_says_what_to_do_and_touches_nothing(tmp_path):
    from lerobot_env_playbyear import PlaybyearEnvConfig

    root = tmp_path / "dataset"
    dataset = RecordDatasetConfig("test/recorded", str(root), 1)
    record(RecordConfig(PlaybyearEnvConfig(), dataset, num_workers=0))
    cut(data_files(root)[0])
    before = everything(tmp_path)
    dataset.num_episodes = 2
    with pytest.raises(PlaybyearError, match=r"playbyear-repair --root="):
        record(RecordConfig(PlaybyearEnvConfig(), dataset, num_workers=0, resume=True))
    assert everything(tmp_path) == before
