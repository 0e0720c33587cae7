"""A save that failed can be repeated, and resuming finishes what a writer of ours had begun: nothing of an episode is lost,
nothing is counted that is not on the disk. All else that is wrong is said, with what to do, and left alone."""

import contextlib
import errno
import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from recording_factory import FEATURES, FILM, REPO_ID, RICH_FEATURES, differences, episode_frames, load
from support.failing import fail_once
from support.recording import add_episode, assert_recorded, edit_info, everything, write, write_episode, writer

from lerobot_playbyear.datasets import durable, episode_files, files
from lerobot_playbyear.datasets.durable import DatasetWriteError, has_dataset
from lerobot_playbyear.datasets.errors import InputError, PlaybyearError
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.datasets.survey import DatasetDamagedError
from lerobot_playbyear.episodes.frames import save_or_ask
from lerobot_playbyear.inspection import SurveyedDataset, check_numbers
from lerobot_playbyear.repair.repair import RepairConfig, repair, repair_dataset
from lerobot_playbyear.training import EpisodeStore

TWO_FILMS = {**RICH_FEATURES, FILM + "2": RICH_FEATURES[FILM]}


def no_room(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A file system of its own, of 4 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("mounting a small disk takes root")
    if subprocess.run([mount, "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder], check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def leave_free(disk: Path, n_bytes: int) -> None:
    """Fills a disk with a file of its own, up to some bytes."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    size = shutil.disk_usage(disk).free - n_bytes
    with ballast.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(size, 1))


def test_on_a_full_disk_every_episode_is_safe_and_a_save_is_repeated_when_there_is_room(disk):
    """Whoever gives up loses that episode alone. With a little more room at every try, it fails a little later each time: the
    last one loses nothing."""
    root = disk / "dataset"
    write(root, [0], RICH_FEATURES)
    leave_free(disk, 8192)
    with pytest.raises(DatasetWriteError, match="the disk is full"):
        write(root, [1], RICH_FEATURES)
    assert_recorded(root, [0], RICH_FEATURES)
    leave_free(disk, 2**20)
    with writer(root, RICH_FEATURES) as target:
        add_episode(target, 1)
        errors = []
        for n_bytes in range(0, 2**21, 8192):
            leave_free(disk, n_bytes)
            try:
                index = target.save_episode()
                break
            except DatasetWriteError as error:
                errors.append(str(error))
            assert target.num_episodes == load(root).num_episodes == 1
        assert len(errors) > 3
        assert all("the disk is full" in error and "call save_episode again" in error for error in errors)
        assert (index, target.num_episodes, target.num_frames) == (1, 2, load(root).num_frames)
        (disk / "ballast").unlink()
        assert write_episode(target, 2) == 2
    assert_recorded(root, range(3), RICH_FEATURES)


@pytest.mark.parametrize(
    ("call", "step", "fault"),
    [("replace", 2, KeyboardInterrupt), ("fsync", 8, OSError(errno.EIO, os.strerror(errno.EIO)))],
)
def test_a_save_is_repeated_wherever_it_failed(tmp_path, monkeypatch, call, step, fault):
    """At the calls by which files come into being and reach their place, in turn; every try gets some calls further."""
    root = tmp_path / "dataset"
    with writer(root, TWO_FILMS) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        failures = 0
        while True:
            with monkeypatch.context() as patch:
                fail_once(patch, os, call, failures, fault)
                try:
                    index = target.save_episode()
                    break
                except (DatasetWriteError, KeyboardInterrupt):
                    failures += step
            assert target.num_episodes == 1
            assert not differences(load(root), {0: 0}, RICH_FEATURES)
            assert failures < 100
        assert failures >= 2 * step
        assert (index, target.num_episodes) == (1, 2)
    assert_recorded(root, range(2), TWO_FILMS)


def test_an_episode_that_failed_is_discarded(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 7)
        with monkeypatch.context() as patch:
            patch.setattr(files.os, "fsync", no_room)
            with pytest.raises(DatasetWriteError, match=r"Episode 1 could not be written.*The 1 episodes before it"):
                target.save_episode()
        with pytest.raises(DatasetWriteError, match=r"Episode 1 is not saved yet: .*save_episode.*discard_episode"):
            target.add_frame(episode_frames(2, FEATURES)[0])
        target.discard_episode()
        assert write_episode(target, 1) == 1
    assert_recorded(root, range(2))
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


def test_an_episode_that_was_published_in_vain_is_there_after_closing(tmp_path, monkeypatch):
    """The journal stood: closing makes the moves that are left."""
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        with monkeypatch.context() as patch:
            fail_once(patch, os, "replace", 2, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
            with pytest.raises(DatasetWriteError, match="Episode 1 is complete on disk"):
                target.save_episode()
            with pytest.raises(DatasetWriteError, match="is complete on disk already"):
                target.discard_episode()
        assert target.num_episodes == load(root).num_episodes == 1
    assert_recorded(root, range(2))


def published_in_vain(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves two episodes, of which the second is complete and not in its place."""
    target = writer(root)
    write_episode(target, 0)
    with monkeypatch.context() as patch:
        fail_once(patch, os, "replace", 1, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        with pytest.raises(DatasetWriteError, match="complete on disk"):
            write_episode(target, 1)
    target._lock.close()


def hide_journal(patch: pytest.MonkeyPatch, *calls: str) -> None:
    """Lets these calls of `os` fail wherever they would tell whether there is a journal."""

    def failing(real: Callable[..., Any], path: Any = ".", **options: Any) -> Any:
        if Path(path).name in ("images", ".journal.json"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return real(path, **options)

    for call in calls:
        patch.setattr(os, call, partial(failing, getattr(os, call)))


def test_a_journal_that_cannot_be_looked_at_now_is_not_taken_for_none(tmp_path, monkeypatch):
    """The episode that it stands for is complete: it is in the dataset once the disk answers again."""
    root = tmp_path / "dataset"
    published_in_vain(root, monkeypatch)
    before = everything(root)
    with monkeypatch.context() as patch:
        hide_journal(patch, "listdir", "lstat")
        with pytest.raises(DatasetWriteError, match="Input/output error"):
            writer(root)
    assert everything(root) == before
    writer(root).close()
    assert_recorded(root, range(2))


def test_while_the_journal_cannot_be_looked_at_a_save_is_asked_for_again_and_nothing_is_given_up(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        with monkeypatch.context() as patch:
            hide_journal(patch, "listdir", "lstat", "stat")
            with pytest.raises(DatasetWriteError, match="Episode 1 could not be written"):
                target.save_episode()
            with pytest.raises(DatasetWriteError, match="call save_episode"):
                target.discard_episode()
        assert target.save_episode() == 1
    assert_recorded(root, range(2))


def test_a_drive_that_is_gone_is_not_begun_anew(tmp_path):
    """What is mounted there instead is an empty folder; when the drive is back, all goes on."""
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        root.rename(tmp_path / "unplugged")
        root.mkdir()
        with pytest.raises(DatasetWriteError):
            target.save_episode()
        assert not (root / "meta").exists()
        shutil.rmtree(root)
        (tmp_path / "unplugged").rename(root)
        assert target.save_episode() == 1
    assert_recorded(root, range(2))


def test_a_frame_that_could_not_be_added_is_not_half_there(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with writer(root) as target:
        for frame in episode_frames(0, FEATURES):
            with monkeypatch.context() as patch:
                patch.setattr(durable, "image_array_to_pil_image", no_room)
                with pytest.raises(OSError, match="No space"):
                    target.add_frame(frame)
            target.add_frame(frame)
        target.save_episode()
    assert_recorded(root, [0])


@pytest.mark.parametrize(("typed", "is_saved"), [("\n\n", True), ("\nq\n", False), ("", False), (None, False)])
def test_a_person_at_the_terminal_is_asked_before_an_episode_is_given_up(tmp_path, monkeypatch, typed, is_saved):
    """Two saves fail, then there is room; an empty terminal is one that nobody sits at, None is no terminal."""
    root = tmp_path / "dataset"
    ours, theirs = os.openpty()
    os.write(ours, (typed or "").encode() or b"\x04")  # end of input
    with writer(root) as target, os.fdopen(theirs) as terminal, monkeypatch.context() as patch:
        write_episode(target, 0)
        failures, real = iter(range(100)), os.replace
        patch.setattr(os, "replace", lambda *args: no_room() if next(failures) < 2 else real(*args))
        patch.setattr(sys, "stdin", None if typed is None else terminal)
        with contextlib.nullcontext() if is_saved else pytest.raises(DatasetWriteError, match="Episode 1"):
            save_or_ask(target, episode_frames(1, FEATURES))
    os.close(ours)
    assert_recorded(root, range(2 if is_saved else 1))


def test_an_episode_that_the_memory_cannot_hold_is_refused_before_the_process_is_killed(tmp_path, monkeypatch):
    """What is there of it can be saved; the next one begins with the memory that is free then."""
    root, frame = tmp_path / "dataset", episode_frames(0, FEATURES)[0]
    free = durable._SPARE_BYTES + 60_000
    monkeypatch.setattr(durable, "available_memory", lambda: free)
    with writer(root) as target:
        assert 0 < target.longest_episode < 60
        n_frames = 0
        with contextlib.suppress(DatasetWriteError):
            for n_frames in range(1000):  # noqa: B007
                target.add_frame(frame)
        assert n_frames < 200
        with pytest.raises(DatasetWriteError, match=rf"Episode 0 has {n_frames} frames \(\d+ s.*Save it now"):
            target.add_frame(frame)
        assert target.save_episode() == 0
        target.add_frame(frame)
        target.save_episode()
    assert [int(length) for length in load(root).meta.episodes["length"]] == [n_frames, 1]


# Resuming what is damaged

N_EPISODES = 4


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    """Each episode in a file of its own."""
    root = tmp_path_factory.mktemp("original") / "dataset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(episode_files, "SMALL_DATA_BYTES", 0)
        write(root, range(N_EPISODES))
    return root


@pytest.fixture
def root(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "parent/dataset"))


def data_file(root: Path, number: int) -> Path:
    return root / f"data/chunk-000/file-{number:03d}.parquet"


def not_synchronised(path: Path) -> None:
    """As a power cut leaves what was written and not synchronised: the size is there, and no content."""
    path.write_bytes(bytes(path.stat().st_size))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def lead_away(name: str) -> Any:
    """A path that leads out of the dataset and back in again: it can be read, and would be written to elsewhere."""
    template = "../dataset/data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    return lambda path: edit_info(path.parents[1], lambda info: info.update({name: template}))


@pytest.mark.parametrize(
    ("damage", "victims"),
    [
        (not_synchronised, [data_file(Path(), 1)]),
        (cut, [data_file(Path(), 2), data_file(Path(), 3)]),
        (Path.unlink, [data_file(Path(), 1), data_file(Path(), 2)]),
        *((Path.unlink, [Path("meta", name)]) for name in ("stats.json", "tasks.parquet", "info.json")),
        *((lead_away(name), [Path("meta/info.json")]) for name in ("data_path", "video_path")),
    ],
)
def test_what_is_damaged_is_neither_dropped_nor_made_anew_in_passing(root, damage, victims):
    for name in victims:
        damage(root / name)
    before = everything(root.parent)
    with pytest.raises(DatasetDamagedError) as error:
        writer(root)
    if "lead_away" not in damage.__qualname__:
        assert f"playbyear-repair --root={root}" in str(error.value)
    assert everything(root.parent) == before
    assert {path.name for path in root.parent.iterdir()} == {"dataset"}
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


READ_BY: dict[str, Callable[[Path], Any]] = {
    "resume": lambda root: writer(root).close(),
    "repair": lambda root: repair_dataset(root).kept,
    "check": lambda root: [str(each) for each in check_numbers(SurveyedDataset.open(REPO_ID, root))],
    "train": lambda root: EpisodeStore.from_dataset(DatasetReader(REPO_ID, root), device="cpu", keys=["action"]).ends,
}


@pytest.mark.parametrize("what", ["resume", "repair", "check", pytest.param("train", marks=pytest.mark.slow)])
def test_a_read_that_failed_once_costs_no_episode(root, monkeypatch, what):
    """An error of the disk, the network or for lack of memory at each read of a table in turn: it is told as such, or what is
    read is read again, and nothing is changed."""
    before, expected, told = everything(root.parent), READ_BY[what](root), []
    for fails_after, code in enumerate(itertools.cycle((errno.ESTALE, errno.EIO, errno.ENOMEM))):
        with monkeypatch.context() as patch:
            error = OSError(code, os.strerror(code))
            calls = fail_once(patch, pq.ParquetFile, "read_row_group", fails_after, error)
            try:
                assert READ_BY[what](root) == expected
            except (OSError, MemoryError, PlaybyearError) as error:
                told.append(str(error))
        assert everything(root.parent) == before
        if next(calls) <= fails_after:
            break
    assert fails_after >= 3
    assert not [error for error in told if "playbyear-repair" in error]
    assert READ_BY[what](root) == expected


@contextlib.contextmanager
def as_nobody(folder: Path, mode: int) -> Iterator[None]:
    """As somebody who may do this with a folder, and read everything around it; takes root."""
    if os.geteuid() != 0:
        pytest.skip("takes root, which becomes somebody else")
    for path in [*folder.rglob("*"), folder, *list(folder.parents)[:4]]:  # pytest's own are closed to others
        path.chmod(path.stat().st_mode | 0o555)
    folder.chmod(mode)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)
        folder.chmod(0o755)


@pytest.mark.parametrize("what", ["parent", "data"])
def test_a_folder_that_cannot_be_listed_is_not_empty(tmp_path, what):
    """Only the names in it tell that it holds a dataset: its metadata are lost."""
    root = tmp_path / "parent/dataset"
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "data/chunk-000/file-000.parquet").touch()
    assert has_dataset(root)
    root.chmod(0o777)
    with as_nobody(root.parent if what == "parent" else root / "data", 0):
        with pytest.raises(PermissionError):
            has_dataset(root)
        with pytest.raises(DatasetWriteError, match="Permission denied"):
            writer(root)
    assert [path.name for path in root.iterdir()] == ["data"]


def test_a_read_only_folder_gives_one_clear_error(root):
    with as_nobody(root, 0o555), pytest.raises(DatasetWriteError, match=f"Cannot write to {root}: Permission denied"):
        writer(root)
    assert_recorded(root, range(N_EPISODES))


def test_an_episode_that_waits_to_be_moved_is_not_called_lost(tmp_path, monkeypatch):
    """Neither where nothing can be written nor by a dry run."""
    root = tmp_path / "dataset"
    published_in_vain(root, monkeypatch)
    before = everything(root)
    with pytest.raises(InputError, match=r"is complete, and still has to be moved .*playbyear-repair --root="):
        repair(RepairConfig(root, dry_run=True))
    with as_nobody(root, 0o555), pytest.raises(InputError, match="Make the folder writable"):
        repair_dataset(root)
    assert everything(root) == before
    assert repair_dataset(root).survey.is_undamaged
    assert_recorded(root, range(2))
