"""A journal is taken for a stranger's: what is moved stays inside the dataset, or nothing is moved at all."""

import os
import shutil
from pathlib import Path

import pytest
from recording_factory import FEATURES, FPS, REPO_ID, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.journal import JOURNAL, STAGING, JournalError, finish_journal, publish


def write(root: Path, number: int) -> None:
    with DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True) as writer:
        for frame in episode_frames(number, FEATURES):
            writer.add_frame(frame)
        writer.save_episode()


@pytest.fixture
def root(tmp_path) -> Path:
    """A dataset of one episode, two folders below one that nothing may reach."""
    root = tmp_path / "outside" / "datasets" / "dataset"
    write(root, 0)
    return root


def everything(folder: Path) -> dict[str, bytes | str]:
    """All files and links below a folder, but locks."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if (path.is_symlink() or path.is_file()) and path.name != ".lock"
    }


def plant(root: Path, names: str = "", victim: str = "data/new.parquet") -> None:
    """A journal as a stranger may write one, with a file that it could move."""
    (root / STAGING / victim).parent.mkdir(parents=True, exist_ok=True)
    (root / STAGING / victim).write_bytes(b"a stranger's")
    (root / JOURNAL).write_text(names)


@pytest.mark.parametrize("names", ["", '["../x", "a/../../../../x"]', "[" * 100_000])
def test_nothing_is_moved_out_of_the_dataset_whatever_a_journal_says(root, tmp_path, names):
    plant(root, names)
    (root / STAGING / "../../x").write_bytes(b"not staged")
    (root / STAGING / "x").write_bytes(b"no file of a dataset")
    before = everything(tmp_path)
    finish_journal(root)
    after = everything(tmp_path)
    where = root.relative_to(tmp_path)
    assert after.pop(str(where / "data/new.parquet")) == b"a stranger's"
    assert before.keys() - after.keys() == {str(where / STAGING / name) for name in ("data/new.parquet", "x")} | {
        str(where / JOURNAL)
    }
    assert all(before[name] == content for name, content in after.items())


def test_no_link_is_followed(root, tmp_path):
    """A link in place of the journal, the scratch folder, or a folder of the dataset or of the staging."""
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / ".staging").mkdir(parents=True)
    for name in ("file-000.mp4", JOURNAL.name, ".staging/thesis.tex"):
        (elsewhere / name).write_bytes(b"the user's own")
    places = {
        root / JOURNAL: root / "meta/info.json",
        root / "videos": elsewhere,
        root / STAGING / "videos": elsewhere,
        root / STAGING / "videos/file-000.mp4": elsewhere / "file-000.mp4",
        root / STAGING: elsewhere,
        root / "images": elsewhere,
    }
    for place, target in places.items():
        shutil.rmtree(root / "images")
        plant(root, victim="videos/file-000.mp4" if place == root / "videos" else "data/new.parquet")
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.symlink_to(target)
        before = everything(tmp_path)
        for refused in (
            lambda: finish_journal(root),
            lambda: publish(root),
            lambda: DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True),
        ):
            if place == root / JOURNAL and refused.__code__.co_names[0] == "publish":
                continue  # it writes its own in its place
            with pytest.raises(JournalError, match=r"is a link|no ordinary file"):
                refused()
            assert everything(tmp_path) == before, place
        assert not (elsewhere / ".lock").exists()
        place.unlink()
        (root / "images").mkdir(exist_ok=True)


def test_a_dataset_that_is_reached_by_a_link_is_written(root, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(root)
    write(link, 1)
    assert link.is_symlink()
    assert load(root).num_episodes == 2
