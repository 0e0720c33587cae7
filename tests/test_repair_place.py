"""Where a repair writes: beside the dataset itself, and nothing half-written ever takes its place."""

import os
import shutil
from pathlib import Path

import pytest
from recording_factory import FEATURES, FPS, REPO_ID, differences, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.repair import DatasetDamagedError, carry_out, check_dataset, repair_dataset, replacing
from lerobot_playbyear.datasets.repair.replacing import finish_repair

N_EPISODES = 3


class Killed(BaseException):
    """What SIGKILL leaves, without ending the test."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "dataset"
    record(root, range(N_EPISODES))
    return root


@pytest.fixture
def root(recorded, tmp_path) -> Path:
    """A dataset that needs repair, and can be repaired without loss."""
    root = Path(shutil.copytree(recorded, tmp_path / "place" / "dataset"))
    (root / "meta/tasks.parquet").unlink()
    return root


def record(root: Path, numbers: range) -> None:
    with DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True) as writer:
        for number in numbers:
            for frame in episode_frames(number, FEATURES):
                writer.add_frame(frame)
            writer.save_episode()


def is_whole(root: Path) -> bool:
    return check_dataset(root).is_sound and not differences(load(root), {n: n for n in range(N_EPISODES)}, FEATURES)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def kill_in_step(monkeypatch, root: Path, step: str) -> None:
    """Begins a repair that is killed while it writes its copy, or between one of the last steps and the next."""

    def die(*_, **__):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        if step == "copying":
            patch.setattr(carry_out, "write_json", die)
        elif step == "copied":
            patch.setattr(replacing.os, "replace", die)  # of the mark
        else:
            rename = os.rename
            calls = iter([die] if step == "marked" else [rename, die])
            patch.setattr(replacing.os, "rename", lambda *names: next(calls)(*names))
        with pytest.raises(Killed):
            repair_dataset(root)


@pytest.mark.parametrize("step", ["copying", "copied"])
def test_a_half_written_copy_is_never_taken_for_the_dataset(root, monkeypatch, tmp_path, step):
    kill_in_step(monkeypatch, root, step)
    root.rename(tmp_path / "moved away")

    finish_repair(root)
    assert not root.exists()
    record(root, range(1))  # a new one

    assert load(root).num_episodes == 1
    repair_dataset(tmp_path / "moved away")
    assert is_whole(tmp_path / "moved away")


def test_a_finished_copy_waits_for_a_word_where_the_dataset_was_moved_away(root, monkeypatch, tmp_path):
    kill_in_step(monkeypatch, root, "marked")
    root.rename(tmp_path / "moved away")
    for resume in (True, False):
        with pytest.raises(DatasetDamagedError, match=r"rename it to .*; otherwise delete it"):
            DurableWriter(REPO_ID, root, FPS, FEATURES, resume=resume)
    assert not root.exists()


@pytest.mark.parametrize("step", ["copying", "copied", "marked", "put aside"])
def test_a_repair_that_was_killed_is_done_again_or_finished(root, monkeypatch, step):
    kill_in_step(monkeypatch, root, step)
    assert root.exists() == (step != "put aside")

    repair_dataset(root)

    assert is_whole(root)
    assert names(root.parent) == ["dataset", "dataset.damaged"]
    assert not (root / "images").exists()


def test_a_folder_that_is_in_the_way_is_not_deleted(root):
    other = root.with_name(".dataset.repairing")
    other.mkdir()
    (other / "of somebody else").touch()
    with pytest.raises(DatasetDamagedError, match="is in the way"):
        repair_dataset(root)
    assert (other / "of somebody else").exists()
    assert not (root / "meta/tasks.parquet").exists()


def test_a_dataset_that_is_written_to_meanwhile_is_left_alone(root, monkeypatch):
    check = repair_dataset.__globals__["check_dataset"]

    def write_to_it(*arguments, **options):
        (root / "data/more.txt").write_text("a recorder that knows no lock")
        return check(*arguments, **options)

    monkeypatch.setitem(repair_dataset.__globals__, "check_dataset", write_to_it)
    with pytest.raises(OSError, match="was changed while it was repaired"):
        repair_dataset(root)
    assert names(root.parent) == ["dataset"]


def test_a_link_stays_a_link_and_the_folder_behind_it_is_repaired_in_its_place(root, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    link = home / "dataset"
    link.symlink_to(root)

    report = repair_dataset(link)

    assert link.is_symlink()
    assert names(home) == ["dataset"]
    assert names(root.parent) == ["dataset", "dataset.damaged"]
    assert report.original == root.with_name("dataset.damaged")
    assert is_whole(link)


def test_a_killed_repair_of_a_link_is_finished_behind_it(root, monkeypatch, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(root)
    kill_in_step(monkeypatch, link, "put aside")
    repair_dataset(link)
    assert link.is_symlink()
    assert is_whole(link)


def test_videos_on_another_disk_stay_there(root, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk/film.txt").write_text("stands for gigabytes")
    (root / "videos").symlink_to(tmp_path / "disk")
    repair_dataset(root)
    assert (root / "videos").readlink() == tmp_path / "disk"


def test_links_within_a_dataset_stay_links(root, tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"elsewhere")
    (root / "videos/camera").mkdir(parents=True)
    (root / "videos/camera/film.mp4").symlink_to(tmp_path / "film.mp4")
    (root / "notes").symlink_to(tmp_path)
    repair_dataset(root)
    assert (root / "videos/camera/film.mp4").readlink() == tmp_path / "film.mp4"
    assert (root / "notes").is_symlink()


def test_a_dataset_that_was_moved_in_parts_says_so(root, tmp_path):
    (root / "data").rename(tmp_path / "data")
    (root / "data").symlink_to(tmp_path / "data")
    report = repair_dataset(root)
    assert f"data was a link to {tmp_path / 'data'}; it is now a folder" in str(report)
    assert is_whole(root)


@pytest.mark.parametrize("part", ["data", "data/chunk-000", "meta/episodes", "meta/episodes/chunk-000"])
@pytest.mark.parametrize("damaged", ["data/chunk-000/file-000.parquet", "meta/tasks.parquet"])
def test_nothing_is_written_behind_a_link_to_a_folder(recorded, tmp_path, part, damaged):
    root = Path(shutil.copytree(recorded, tmp_path / "place" / "dataset"))
    disk = tmp_path / "disk"
    shutil.move(root / part, disk)
    (root / part).symlink_to(disk)
    (disk / "of somebody else").write_text("no part of the dataset")
    if damaged.startswith("data"):
        os.truncate(root / damaged, (root / damaged).stat().st_size - 30)
    else:
        (root / damaged).unlink()
    before = {path: path.read_bytes() for path in disk.rglob("*") if path.is_file()}

    report = repair_dataset(root)

    assert {path: path.read_bytes() for path in disk.rglob("*") if path.is_file()} == before
    assert f"{part} was a link to {disk}; it is now a folder" in str(report)
    assert is_whole(root)
    assert not (root / part / "of somebody else").exists()
