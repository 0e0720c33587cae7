"""A journal is taken for a stranger's: what is moved stays inside the dataset, or nothing is moved at all."""

import json
import os
import shutil
from pathlib import Path

import pytest
from recording_factory import FEATURES, FPS, REPO_ID, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.journal import JOURNAL, STAGING, JournalError, finish_journal, publish
from lerobot_playbyear.repair import repair_dataset


@pytest.fixture
def root(tmp_path) -> Path:
    """A dataset of one episode, two folders below one that nothing may reach."""
    root = tmp_path / "outside" / "datasets" / "dataset"
    with DurableWriter(REPO_ID, root, FPS, FEATURES) as writer:
        for frame in episode_frames(0, FEATURES):
            writer.add_frame(frame)
        writer.save_episode()
    return root


def everything(folder: Path) -> dict[str, bytes | str]:
    """All files and links below a folder, but locks."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if (path.is_symlink() or path.is_file()) and path.name != ".lock"
    }


def plant(root: Path, names: object = "", victim: str = "data/new.parquet") -> None:
    """A journal as a stranger may write one, with a file that it could move."""
    (root / STAGING / victim).parent.mkdir(parents=True, exist_ok=True)
    (root / STAGING / victim).write_bytes(b"a stranger's")
    (root / JOURNAL).write_text(names if isinstance(names, str) else json.dumps(names))


def assert_refused(root: Path, tmp_path: Path, message: str) -> None:
    before = everything(tmp_path)
    for open_it in (
        lambda: finish_journal(root),
        lambda: DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True),
        lambda: repair_dataset(root),
    ):
        with pytest.raises(JournalError, match=message):
            open_it()
        assert everything(tmp_path) == before


def test_a_journal_of_an_older_version_is_finished(root):
    """It names the files that are staged."""
    names = ["data/new.parquet", "videos/camera/film.mp4", "meta/episodes/chunk-000/new.parquet", "meta/info.json"]
    for name in names:
        plant(root, names, name)
    info = (root / "meta/info.json").read_bytes()
    (root / STAGING / "meta/info.json").write_bytes(info)
    finish_journal(root)
    assert [(root / name).read_bytes() for name in names] == [b"a stranger's"] * 3 + [info]
    assert not (root / JOURNAL).exists()


@pytest.mark.parametrize("names", [["../x", "/tmp/x"], ["a/../../../../x"], "", "{", "[" * 100_000, 3, None])
def test_nothing_is_moved_out_of_the_dataset_whatever_a_journal_says(root, tmp_path, names):
    plant(root, names)
    (root / STAGING / "../../x").write_bytes(b"not staged")
    (root / STAGING / "x").write_bytes(b"no file of a dataset")
    (root / STAGING / "images").mkdir()
    (root / STAGING / "images/frame.png").write_bytes(b"nor this")
    before = everything(tmp_path)
    finish_journal(root)
    after = everything(tmp_path)
    where = root.relative_to(tmp_path)
    assert after.pop(str(where / "data/new.parquet")) == b"a stranger's"
    assert before.keys() - after.keys() == {str(where / STAGING / "data/new.parquet"), str(where / JOURNAL)}
    assert all(before[name] == content for name, content in after.items())


def test_a_journal_that_is_no_file_is_refused(root, tmp_path):
    plant(root)
    (root / JOURNAL).unlink()
    os.mkfifo(root / JOURNAL)
    with pytest.raises(JournalError, match="no ordinary file"):
        finish_journal(root)
    (root / JOURNAL).unlink()
    (root / JOURNAL).symlink_to(root / "meta/info.json")
    assert_refused(root, tmp_path, "no ordinary file")


def test_links_lead_nowhere(root, tmp_path):
    """A folder of the dataset, or of the staging, that is a link to somewhere else."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "file-000.mp4").write_bytes(b"the user's own")
    (root / "videos").symlink_to(elsewhere)
    plant(root, victim="videos/file-000.mp4")
    assert_refused(root, tmp_path, "is a link")
    (root / "videos").unlink()

    (root / STAGING / "videos/file-000.mp4").unlink()
    (root / STAGING / "videos").rmdir()
    (root / STAGING / "videos").symlink_to(elsewhere)
    assert_refused(root, tmp_path, "is a link")

    (root / STAGING / "videos").unlink()
    (root / STAGING / "videos").mkdir()
    (root / STAGING / "videos/file-000.mp4").symlink_to(elsewhere / "file-000.mp4")
    assert_refused(root, tmp_path, "is a link")


@pytest.mark.parametrize("name", ["images", "images/.staging", "images/.episode"])
def test_a_scratch_folder_that_is_a_link_is_left_alone(root, tmp_path, name):
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / ".staging").mkdir(parents=True)
    (elsewhere / "thesis.tex").write_text("mine")
    (elsewhere / ".staging" / "thesis.tex").write_text("mine")
    if name == "images":
        shutil.rmtree(root / name)
    (root / name).symlink_to(elsewhere)
    before = everything(elsewhere)
    with pytest.raises(JournalError, match="is a link"):
        DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True)
    assert everything(elsewhere) == before
    assert not (elsewhere / ".lock").exists()


def test_nothing_is_published_that_could_not_be_finished(root, tmp_path):
    """Before the journal stands: an episode that counts must be able to reach its place."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (root / "videos").symlink_to(elsewhere)
    (root / STAGING / "videos").mkdir(parents=True)
    (root / STAGING / "videos/file-000.mp4").write_bytes(b"film")
    with pytest.raises(JournalError, match="is a link"):
        publish(root)
    assert not (root / JOURNAL).exists()
    assert not any(elsewhere.iterdir())


def test_a_dataset_that_is_reached_by_a_link_is_written(root, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(root)
    plant(link)
    finish_journal(link)
    assert (root / "data/new.parquet").read_bytes() == b"a stranger's"
    (root / "data/new.parquet").unlink()
    with DurableWriter(REPO_ID, link, FPS, FEATURES, resume=True) as writer:
        for frame in episode_frames(1, FEATURES):
            writer.add_frame(frame)
        writer.save_episode()
    assert link.is_symlink()
    assert load(root).num_episodes == 2
