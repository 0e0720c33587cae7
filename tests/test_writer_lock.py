"""At most one process writes to a dataset, whatever the order in which locks are let go and taken."""

import contextlib
import errno
import multiprocessing
import os
import random
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from recording_factory import FEATURES, FPS, REPO_ID, differences, episode_frames, load

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.journal import LOCK, SCRATCH
from lerobot_playbyear.datasets.locking import DatasetLock, DatasetLockedError


def hold(root: str, n_times: int, answers) -> None:
    """Takes the lock so many times, and notes when another one has it as well."""
    end = time.monotonic() + 60.0
    taken = doubled = 0
    marker = Path(root) / "held"
    while taken < n_times and time.monotonic() < end:
        try:
            lock = DatasetLock(Path(root))
        except DatasetLockedError:
            time.sleep(random.uniform(0.0, 0.003))  # or all of them only ever stand in each other's way
            continue
        except BaseException as error:
            answers.put(error)
            raise
        try:
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            doubled += 1
        else:
            taken += 1
            time.sleep(0.0005)
            marker.unlink()
        lock.release()
        time.sleep(0.001)  # let another one have it
    answers.put((taken, doubled))


def try_to_take(root: str, answers) -> None:
    try:
        lock = DatasetLock(Path(root))
    except DatasetLockedError:
        answers.put("locked")
    else:
        answers.put("taken")
        lock.release()


@pytest.fixture(scope="module")
def processes():
    return multiprocessing.get_context("fork")


def test_who_lets_a_lock_go_does_not_take_it_from_the_next(tmp_path, processes):
    """One lets go, the next takes it while the first one tidies up: a third gets nothing."""
    first = DatasetLock(tmp_path)
    seconds: list[DatasetLock] = []
    real = os.unlink

    def unlink(path, *args, **kwargs):
        with contextlib.suppress(DatasetLockedError):
            seconds.append(DatasetLock(tmp_path))
        real(path, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "unlink", unlink)
        first.release()
    if not seconds:
        seconds.append(DatasetLock(tmp_path))
    answers = processes.Queue()
    third = processes.Process(target=try_to_take, args=(str(tmp_path), answers))
    third.start()
    assert answers.get(timeout=30) == "locked"
    third.join()
    seconds[0].release()


def test_a_writer_that_closes_does_not_let_two_others_in(tmp_path):
    """The second one opens the dataset at the moment in which the first one removes the lock's file."""
    root = tmp_path / "dataset"

    def open_writer() -> DurableWriter:
        return DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True)

    first = open_writer()
    seconds: list[DurableWriter] = []
    real, is_first = os.unlink, iter([True])

    def unlink(path, *args, **kwargs):
        if Path(path) == root / LOCK and next(is_first, False):
            with contextlib.suppress(DatasetWriteError):
                seconds.append(open_writer())
        real(path, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "unlink", unlink)
        first.close()
    second = seconds[0] if seconds else open_writer()
    with pytest.raises(DatasetWriteError, match="Another process is writing"):
        open_writer()
    second.close()


def test_two_processes_never_hold_it_at_once(tmp_path, processes):
    answers = processes.Queue()
    workers = [processes.Process(target=hold, args=(str(tmp_path), 10, answers)) for _ in range(4)]
    for worker in workers:
        worker.start()
    found = [answers.get(timeout=90) for _ in workers]
    for worker in workers:
        worker.join()
    assert not [answer for answer in found if isinstance(answer, BaseException)]
    assert sum(taken for taken, _ in found) >= 10  # all 40, unless the machine has much else to do
    assert sum(doubled for _, doubled in found) == 0


def test_nothing_stays_of_a_lock(tmp_path):
    lock = DatasetLock(tmp_path)
    assert (tmp_path / LOCK).exists()
    with pytest.raises(DatasetLockedError, match="Another process is writing"):
        DatasetLock(tmp_path)
    lock.release()
    lock.release()
    assert not (tmp_path / SCRATCH).exists()


def test_frames_of_another_tool_stay_where_they_are(tmp_path):
    (tmp_path / SCRATCH / "camera").mkdir(parents=True)
    DatasetLock(tmp_path).release()
    assert (tmp_path / SCRATCH / "camera").is_dir()
    assert not (tmp_path / LOCK).exists()


def test_a_lock_of_a_folder_that_was_moved_lets_nobody_into_the_next(tmp_path):
    root = tmp_path / "set"
    moved = DatasetLock(root)
    root.rename(tmp_path / "moved")
    current = DatasetLock(root)
    moved.release()
    with pytest.raises(DatasetLockedError):
        DatasetLock(root)
    current.release()


@pytest.mark.skipif(os.name == "nt", reason="Windows locks files in another way")
@pytest.mark.filterwarnings("ignore:flock not supported")
def test_a_disk_without_locks_of_the_system_is_locked_by_a_file(tmp_path, monkeypatch):
    import fcntl

    def fail(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", fail)
    lock = DatasetLock(tmp_path / "set")
    with pytest.raises(DatasetLockedError):
        DatasetLock(tmp_path / "set")
    lock.release()
    assert not (tmp_path / "set" / SCRATCH).exists()
    DatasetLock(tmp_path / "set").release()


def test_a_lock_is_held_and_let_go_by_every_thread(tmp_path):
    lock = DatasetLock(tmp_path / "set")
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: lock.is_held).result()
        pool.submit(lock.release).result()
    assert not lock.is_held
    DatasetLock(tmp_path / "set").release()


def test_a_writer_whose_folder_was_moved_harms_no_episode_of_the_next(tmp_path):
    root = tmp_path / "set"
    frames = episode_frames(0, FEATURES)
    first = DurableWriter(REPO_ID, root, FPS, FEATURES)
    first.add_frame(frames[0])
    root.rename(tmp_path / "moved")
    with DurableWriter(REPO_ID, root, FPS, FEATURES) as second:
        for frame in frames[:-1]:
            second.add_frame(frame)
        for step in (lambda: first.add_frame(frames[0]), first.save_episode, first.discard_episode):
            with pytest.raises(DatasetWriteError, match="another program writes to"):
                step()
        first.close()
        second.add_frame(frames[-1])
        second.save_episode()
    assert load(root).num_episodes == 1
    assert not differences(load(root), {0: 0}, FEATURES)
