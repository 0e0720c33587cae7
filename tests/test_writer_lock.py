"""At most one process writes to a dataset, whatever the order in which locks are let go and taken."""

import errno
import multiprocessing
import os
import random
import time
from pathlib import Path

import pytest
from recording_factory import FEATURES, FPS, REPO_ID

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.files import FolderLockedError
from lerobot_playbyear.datasets.journal import LOCK, SCRATCH, lock_dataset


def hold(root: str, n_times: int, answers) -> None:
    """Takes the lock so many times, and notes when another one has it as well."""
    end = time.monotonic() + 60.0
    taken = doubled = 0
    marker = Path(root) / "held"
    while taken < n_times and time.monotonic() < end:
        try:
            lock = lock_dataset(Path(root))
        except FolderLockedError:
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


def test_two_processes_never_hold_it_at_once(tmp_path):
    processes = multiprocessing.get_context("fork")
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


def test_a_second_writer_waits_until_the_first_has_closed(tmp_path):
    root = tmp_path / "dataset"
    with DurableWriter(REPO_ID, root, FPS, FEATURES) as first:
        with pytest.raises(FolderLockedError, match="Another process is writing"):
            DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True)
        first.close()
        DurableWriter(REPO_ID, root, FPS, FEATURES, resume=True).close()


def test_no_link_is_followed_to_a_lock(tmp_path):
    root, elsewhere = tmp_path / "dataset", tmp_path / "elsewhere"
    (root / SCRATCH).mkdir(parents=True)
    (root / LOCK).symlink_to(elsewhere)
    with pytest.raises(OSError, match="symbolic link"):
        lock_dataset(root)
    assert not elsewhere.exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows locks files in another way")
@pytest.mark.filterwarnings("ignore:flock not supported")
def test_a_disk_without_locks_of_the_system_is_locked_by_a_file(tmp_path, monkeypatch):
    import fcntl

    def fail(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", fail)
    lock = lock_dataset(tmp_path / "set")
    with pytest.raises(FolderLockedError):
        lock_dataset(tmp_path / "set")
    lock.release()
    lock_dataset(tmp_path / "set").release()
