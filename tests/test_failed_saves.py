"""A save that failed can be repeated: nothing of the episode is lost, nothing is counted that is not on the disk."""

import contextlib
import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs.video import RGBEncoderConfig
from recording_factory import FEATURES, FILM, FPS, REPO_ID, RICH_FEATURES, differences, episode_frames, load

from lerobot_playbyear.datasets import durable, episode_files, files
from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.episodes.frames import save_or_ask

ENCODER = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
TWO_FILMS = {**RICH_FEATURES, FILM + "2": RICH_FEATURES[FILM]}


def writer(root: Path, features: dict[str, Any] = FEATURES, **options) -> DurableWriter:
    return DurableWriter(REPO_ID, root, FPS, features, **{"rgb_encoder": ENCODER, "resume": True, **options})


def add_episode(target: DurableWriter, number: int) -> None:
    for frame in episode_frames(number, target.features):
        target.add_frame(frame)


def write_episode(target: DurableWriter, number: int) -> int:
    add_episode(target, number)
    return target.save_episode()


def assert_recorded(root: Path, n_episodes: int, features: dict[str, Any] = FEATURES) -> None:
    dataset = load(root)
    assert dataset.num_episodes == n_episodes
    films = {key: feature for key, feature in features.items() if key != FILM + "2"}
    assert not differences(dataset, {n: n for n in range(n_episodes)}, films)
    assert int(dataset.meta.stats["action"]["count"][0]) == dataset.num_frames
    assert survey(root).is_sound


def no_room(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A file system of 4 MB."""
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


def test_a_save_on_a_full_disk_is_repeated_when_there_is_room(disk):
    """With a little more room at every try, it fails a little later each time: the last one loses nothing."""
    root = disk / "dataset"
    with writer(root, RICH_FEATURES) as target:
        write_episode(target, 0)
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
    assert_recorded(root, 3, RICH_FEATURES)


FAULTS = {
    "full disk": lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    "broken disk": lambda: OSError(errno.EIO, os.strerror(errno.EIO)),
    "interrupt": KeyboardInterrupt,
}


@pytest.mark.parametrize(
    ("module", "call", "step", "fault"),
    [
        (os, "replace", 1, "full disk"),
        (os, "replace", 1, "interrupt"),
        (os, "fsync", 4, "broken disk"),
        (episode_files, "encode_video_frames", 1, "broken disk"),
        (episode_files, "encode_video_frames", 1, "interrupt"),
    ],
)
def test_a_save_is_repeated_wherever_it_failed(tmp_path, monkeypatch, module, call, step, fault):
    """At the calls by which files come into being and reach their place, in turn; every try gets some calls further."""
    root = tmp_path / "dataset"
    with writer(root, TWO_FILMS) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        failures, real = 0, getattr(module, call)
        while True:
            calls = iter(range(10**6))

            def fail_later(*args, calls=calls, after=failures, **kwargs):
                if next(calls) == after:
                    raise FAULTS[fault]()
                return real(*args, **kwargs)

            with monkeypatch.context() as patch:
                patch.setattr(module, call, fail_later)
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
    assert_recorded(root, 2, TWO_FILMS)


def fail_to_save(target: DurableWriter) -> None:
    """Lets the episode in progress fail, on a disk that is whole again afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files.os, "fsync", no_room)
        with pytest.raises(DatasetWriteError, match=r"Episode 1 could not be written.*The 1 episodes before it"):
            target.save_episode()


@pytest.mark.parametrize("what", ["is saved", "is discarded", "is left to the next process"])
def test_an_episode_that_failed(tmp_path, caplog, what):
    root = tmp_path / "dataset"
    target = writer(root)
    write_episode(target, 0)
    add_episode(target, 1 if what == "is saved" else 7)
    fail_to_save(target)
    with pytest.raises(DatasetWriteError, match=r"Episode 1 is not saved yet: .*save_episode.*discard_episode"):
        target.add_frame(episode_frames(2, FEATURES)[0])
    if what == "is saved":
        assert target.save_episode() == 1
    elif what == "is discarded":
        target.discard_episode()
        assert write_episode(target, 1) == 1
    else:
        target._lock.release()  # as at the end of a process that was killed
        target = writer(root)
        assert target.num_episodes == 1
        assert "an episode that had not been saved was removed" in caplog.text
        assert write_episode(target, 1) == 1
    target.close()
    assert_recorded(root, 2)
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


def test_an_episode_that_was_published_in_vain_is_there_after_closing(tmp_path, monkeypatch):
    """The journal stood: closing makes the moves that are left."""
    root = tmp_path / "dataset"
    real, calls = os.replace, iter(range(100))
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", lambda *args: no_room() if next(calls) == 2 else real(*args))
            with pytest.raises(DatasetWriteError, match="Episode 1 is complete on disk"):
                target.save_episode()
            with pytest.raises(DatasetWriteError, match="is complete on disk already"):
                target.discard_episode()
        assert target.num_episodes == load(root).num_episodes == 1
    assert_recorded(root, 2)


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
    assert_recorded(root, 2)


def test_a_frame_that_could_not_be_added_is_not_half_there(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with writer(root) as target:
        for frame in episode_frames(0, FEATURES):
            with monkeypatch.context() as patch, contextlib.suppress(OSError):
                patch.setattr(durable, "image_array_to_pil_image", no_room)
                target.add_frame(frame)
                pytest.fail("it was added")
            target.add_frame(frame)
        target.save_episode()
    assert_recorded(root, 1)


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
    assert_recorded(root, 2 if is_saved else 1)


def test_an_episode_without_frames_is_no_episode(tmp_path):
    with writer(tmp_path / "dataset") as target:
        with pytest.raises(DatasetWriteError, match="Episode 0 has no frames"):
            target.save_episode()
        assert write_episode(target, 0) == 0
    assert_recorded(tmp_path / "dataset", 1)


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
