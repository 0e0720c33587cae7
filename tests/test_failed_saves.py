"""A save that failed can be repeated: nothing of the episode is lost, nothing is counted that is not on the disk."""

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lerobot.datasets.dataset_writer
import numpy as np
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets import image_writer
from recording_factory import FEATURES, FILM, FPS, REPO_ID, RICH_FEATURES, differences, episode_frames, load

from lerobot_playbyear.datasets import journal
from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter
from lerobot_playbyear.datasets.staging import Staging
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.episodes.saving import save_or_ask

ENCODER = RGBEncoderConfig(vcodec="h264", preset="ultrafast")
TWO_FILMS = {**RICH_FEATURES, FILM + "2": RICH_FEATURES[FILM]}


def writer(root: Path, features: dict[str, Any] = RICH_FEATURES, **options) -> DurableWriter:
    return DurableWriter(REPO_ID, root, FPS, features, **{"rgb_encoder": ENCODER, "resume": True, **options})


def add_episode(target: DurableWriter, number: int) -> None:
    for frame in episode_frames(number, target.features):
        target.add_frame(frame)


def write_episode(target: DurableWriter, number: int) -> int:
    add_episode(target, number)
    return target.save_episode()


def assert_recorded(root: Path, n_episodes: int, features: dict[str, Any] = RICH_FEATURES) -> None:
    dataset = load(root)
    assert dataset.num_episodes == n_episodes
    films = {key: feature for key, feature in features.items() if key != FILM + "2"}
    assert not differences(dataset, {n: n for n in range(n_episodes)}, films)
    assert int(dataset.meta.stats["action"]["count"][0]) == dataset.num_frames
    assert survey(root).is_sound


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
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        target._episode.dataset.writer.image_writer.wait_until_done()
        errors = []
        for n_bytes in range(0, 2**21, 16384):
            leave_free(disk, n_bytes)
            try:
                index = target.save_episode()
                break
            except DatasetWriteError as error:
                errors.append(error)
            assert target.num_episodes == load(root).num_episodes == 1
        assert len(errors) > 3
        assert all(error.can_be_repeated for error in errors)
        assert all("the disk is full" in str(error) and "call save_episode again" in str(error) for error in errors)
        assert index == 1
        assert (target.num_episodes, target.num_frames) == (2, load(root).num_frames)
        assert_recorded(root, 2)
        (disk / "ballast").unlink()
        assert write_episode(target, 2) == 2
    assert_recorded(root, 3)


FAULTS = {
    "full disk": lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    "broken disk": lambda: OSError(errno.EIO, os.strerror(errno.EIO)),
    "interrupt": KeyboardInterrupt,
}


@pytest.mark.parametrize(
    ("call", "step", "fault"),
    [("replace", 1, "full disk"), ("replace", 1, "interrupt"), ("fsync", 4, "broken disk")],
)
def test_a_save_is_repeated_wherever_it_failed(tmp_path, monkeypatch, call, step, fault):
    """At the calls by which files reach their place, in turn; every try gets some calls further."""
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        failures, real = 0, getattr(os, call)
        while True:
            calls = iter(range(10**6))

            def fail_later(*args, calls=calls, after=failures):
                if next(calls) == after:
                    raise FAULTS[fault]()
                return real(*args)

            with monkeypatch.context() as patch:
                patch.setattr(journal.os, call, fail_later)
                try:
                    index = target.save_episode()
                    break
                except (DatasetWriteError, KeyboardInterrupt):
                    failures += step
            assert target.num_episodes == json.loads((root / "meta/info.json").read_text())["total_episodes"]
            dataset = load(root)
            assert not differences(dataset, {0: 0}, RICH_FEATURES)
            assert failures < 100
        assert failures > 2 * step
        assert index == 1
        assert target.num_episodes == 2
    assert_recorded(root, 2)


@pytest.mark.parametrize("fault", FAULTS)
def test_an_encoder_that_failed_is_asked_again(tmp_path, monkeypatch, fault):
    """The second film's; LeRobot has deleted the pictures of the first one by then."""
    root = tmp_path / "dataset"
    with writer(root, TWO_FILMS) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        real, calls = lerobot.datasets.dataset_writer.encode_video_frames, iter(range(10))

        def encode(*args, **kwargs):
            if next(calls) == 1:
                raise FAULTS[fault]()
            return real(*args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(lerobot.datasets.dataset_writer, "encode_video_frames", encode)
            with pytest.raises((DatasetWriteError, KeyboardInterrupt)):
                target.save_episode()
        assert target.num_episodes == 1
        assert target.save_episode() == 1
        write_episode(target, 2)
    assert_recorded(root, 3, TWO_FILMS)


def fail_to_save(target: DurableWriter) -> None:
    """Lets the episode in progress fail, on a disk that is whole again afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal.os, "fsync", _no_room)
        with pytest.raises(DatasetWriteError, match=r"Episode 1 could not be written.*The 1 episodes before it"):
            target.save_episode()


def test_frames_do_not_get_into_an_episode_that_waits_to_be_saved(tmp_path):
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        fail_to_save(target)
        with pytest.raises(DatasetWriteError, match=r"Episode 1 is not saved yet: .*save_episode.*discard_episode"):
            target.add_frame(episode_frames(2, FEATURES)[0])
        assert target.save_episode() == 1
    assert_recorded(root, 2, FEATURES)


def test_an_episode_that_was_not_saved_can_be_discarded(tmp_path):
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        write_episode(target, 0)
        add_episode(target, 7)
        fail_to_save(target)
        target.discard_episode()
        assert target.num_episodes == 1
        assert write_episode(target, 1) == 1
    assert_recorded(root, 2, FEATURES)


def test_what_a_process_could_not_save_is_rolled_back_by_the_next(tmp_path, caplog):
    root = tmp_path / "dataset"
    target = writer(root, FEATURES)
    write_episode(target, 0)
    add_episode(target, 7)
    fail_to_save(target)
    target._lock.release()  # as at the end of a process that was killed
    with writer(root, FEATURES) as target:
        assert target.num_episodes == 1
        assert "an episode that had not been saved was removed" in caplog.text
        assert write_episode(target, 1) == 1
    assert_recorded(root, 2, FEATURES)
    assert {path.name for path in root.iterdir()} == {"data", "meta", "images"}
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


def test_a_process_that_was_killed_between_two_episodes_left_nothing_to_be_told(tmp_path, caplog):
    root = tmp_path / "dataset"
    target = writer(root, FEATURES)
    write_episode(target, 0)
    target._lock.release()  # as at the end of a process that was killed
    with writer(root, FEATURES) as target:
        assert target.num_episodes == 1
    assert "removed" not in caplog.text


def test_an_episode_that_was_published_in_vain_is_there_after_closing(tmp_path, monkeypatch):
    """The journal stood: closing makes the moves that are left."""
    root = tmp_path / "dataset"
    real, calls = os.replace, iter(range(100))

    def replace(*args):
        if next(calls) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(*args)

    with writer(root, FEATURES) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        with monkeypatch.context() as patch:
            patch.setattr(journal.os, "replace", replace)
            with pytest.raises(DatasetWriteError, match="Episode 1 is complete on disk"):
                target.save_episode()
        assert target.num_episodes == load(root).num_episodes == 1
    assert_recorded(root, 2, FEATURES)


@pytest.mark.parametrize("after_frames", [True, False])
def test_a_drive_that_is_gone_is_not_begun_anew(tmp_path, after_frames):
    """What is mounted there instead is an empty folder; when the drive is back, all goes on."""
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        write_episode(target, 0)
        if after_frames:
            add_episode(target, 1)
            target._episode.dataset.writer.image_writer.wait_until_done()
        root.rename(tmp_path / "unplugged")
        root.mkdir()
        with pytest.raises(DatasetWriteError):
            target.save_episode() if after_frames else write_episode(target, 1)
        assert not (root / "meta").exists()
        while root.exists():  # LeRobot's threads may still write pictures into it
            shutil.rmtree(root, ignore_errors=True)
        (tmp_path / "unplugged").rename(root)
        if not after_frames:
            target.discard_episode()
            add_episode(target, 1)
        assert target.save_episode() == 1
    assert_recorded(root, 2, FEATURES)


def test_a_frame_that_could_not_be_added_is_not_half_there(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        frames = episode_frames(0, FEATURES)
        for number, frame in enumerate(frames):
            with monkeypatch.context() as patch, contextlib.suppress(DatasetWriteError):
                patch.setattr(Path, "mkdir", _no_room)
                patch.setattr(target._staging.dataset.writer, "_save_image", _no_room)
                target.add_frame(frame)
                pytest.fail("it was added")
            target.add_frame(frame)
            assert target._staging.length == number + 1
        target.save_episode()
    assert_recorded(root, 1, FEATURES)


@pytest.mark.parametrize(("typed", "is_saved"), [("\n\n", True), ("\nq\n", False), ("", False)])
def test_a_person_at_the_terminal_is_asked_before_an_episode_is_given_up(tmp_path, monkeypatch, typed, is_saved):
    """Two saves fail, then there is room; an empty terminal is one that nobody sits at."""
    root = tmp_path / "dataset"
    ours, theirs = os.openpty()
    os.write(ours, typed.encode() or b"\x04")  # end of input
    with writer(root, FEATURES) as target, os.fdopen(theirs) as terminal, monkeypatch.context() as patch:
        write_episode(target, 0)
        failures, real = iter(range(100)), os.replace

        def replace(*args):
            if next(failures) < 2:
                _no_room()
            real(*args)

        patch.setattr(journal.os, "replace", replace)
        patch.setattr(sys, "stdin", terminal)
        with contextlib.nullcontext() if is_saved else pytest.raises(DatasetWriteError, match="Episode 1"):
            save_or_ask(target, episode_frames(1, FEATURES))
    os.close(ours)
    assert_recorded(root, 2 if is_saved else 1, FEATURES)


def test_without_a_terminal_nobody_is_asked(tmp_path, monkeypatch):
    with writer(tmp_path / "dataset", FEATURES) as target:
        monkeypatch.setattr(journal.os, "fsync", _no_room)
        with open(os.devnull) as nothing:
            monkeypatch.setattr(sys, "stdin", nothing)
            with pytest.raises(DatasetWriteError, match="call save_episode again"):
                save_or_ask(target, episode_frames(0, FEATURES))
        monkeypatch.undo()


@pytest.mark.parametrize("is_given_up", [False, True])
@pytest.mark.parametrize("what", ["pictures", "a frame"])
def test_an_episode_in_memory_is_written_anew_where_its_pictures_did_not_reach_the_disk(
    tmp_path, monkeypatch, what, is_given_up
):
    root, questions = tmp_path / "dataset", []
    real, real_write = Staging.add_frame, image_writer.write_image

    def no_room_for_the_third(staging, frame):
        if staging.length == 2 and not questions:
            _no_room()
        real(staging, frame)

    def no_pictures(*args, **kwargs):  # LeRobot's threads log it, and go on
        if questions:
            real_write(*args, **kwargs)

    def answer(question):
        questions.append(question)
        return "q" if is_given_up else ""

    ours, theirs = os.openpty()
    with writer(root, FEATURES) as target, os.fdopen(theirs) as terminal:
        write_episode(target, 0)
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr("builtins.input", answer)
        if what == "pictures":
            monkeypatch.setattr(image_writer, "write_image", no_pictures)
        else:
            monkeypatch.setattr(Staging, "add_frame", no_room_for_the_third)
        with pytest.raises(DatasetWriteError) if is_given_up else contextlib.nullcontext():
            save_or_ask(target, episode_frames(1, FEATURES))
        assert len(questions) == 1
        assert "still in memory" in questions[0]
        if is_given_up:
            save_or_ask(target, episode_frames(1, FEATURES))
    os.close(ours)
    assert_recorded(root, 2, FEATURES)


def _no_room(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_episode_without_frames_is_no_episode(tmp_path):
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        with pytest.raises(DatasetWriteError, match="Episode 0 has no frames"):
            target.save_episode()
        assert write_episode(target, 0) == 0
    assert_recorded(root, 1, FEATURES)


def test_sound_of_a_repeated_save_is_there_once(tmp_path):
    root = tmp_path / "dataset"
    with writer(root, FEATURES) as target:
        write_episode(target, 0)
        add_episode(target, 1)
        fail_to_save(target)
        target.save_episode()
    stats = load(root).meta.stats
    frames = [frame for number in (0, 1) for frame in episode_frames(number, FEATURES)]
    samples = np.concatenate([frame["observation.audio.gripper"] for frame in frames])
    assert int(stats["observation.audio.gripper"]["count"][0]) == len(frames)
    np.testing.assert_allclose(stats["observation.audio.gripper"]["std"], samples.std(), rtol=1e-3)
