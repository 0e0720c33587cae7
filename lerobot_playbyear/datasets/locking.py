"""At most one process writes to a dataset, and none while it is uploaded."""

import contextlib
import os
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from lerobot_playbyear.datasets.errors import DatasetWriteError
from lerobot_playbyear.datasets.journal import LOCK, SCRATCH, check_scratch

_MOST_TRIES = 100  # each loses against another process that lets the lock go at this very moment


class DatasetLockedError(DatasetWriteError):
    """Another process writes to the dataset, or uploads it."""


class DatasetLock:
    """Held from its making until `release`; the operating system lets go of it when the process ends, however it does.

    The lock's file is removed by the process that holds it, before it lets go. So a file that was locked may be one
    that is gone already, and who locks one looks whether it is still the one that the others will find.

    Args:
        root: The dataset's folder; it is made where it is missing.

    Raises:
        DatasetLockedError: Another process holds it.
        JournalError: The folder it lies in is a link.
        OSError: It cannot be written.
    """

    def __init__(self, root: Path) -> None:
        check_scratch(root)
        self._path = root / LOCK
        for _ in range(_MOST_TRIES):
            try:
                (root / SCRATCH).mkdir(parents=True, exist_ok=True)
                lock = self._take()
            except (FileNotFoundError, FileExistsError):  # whoever let go removes the folder just now
                if (root / SCRATCH).is_file():
                    raise
                continue
            except Timeout:
                break
            if lock is not None:
                self._lock = lock
                self._file = os.stat(self._path)
                return
        raise DatasetLockedError(f"Another process is writing to {root}, or uploading it: wait until it has ended.")

    @property
    def is_held(self) -> bool:
        """Whether it was not released yet."""
        return self._lock.is_locked

    @property
    def is_replaced(self) -> bool:
        """Whether there is another dataset now, with a lock of its own, where the dataset's folder was."""
        try:
            return not os.path.samestat(os.lstat(self._path), self._file)
        except OSError:
            return False

    def moved_to(self, root: Path) -> None:
        """Says that the dataset's folder, and the lock in it, has another name now."""
        self._path = root / LOCK

    def release(self) -> None:
        """Lets go, and leaves nothing behind. Safe to call twice."""
        if not self._lock.is_locked:
            return
        if not self.is_replaced:
            with contextlib.suppress(OSError):  # Windows removes no open file: there it stays
                self._path.unlink()
                self._path.parent.rmdir()
        self._lock.release()

    def _open(self) -> tuple[int, bool]:
        """The lock's file, and whether it was not there before."""
        flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)
        try:
            return os.open(self._path, flags | os.O_CREAT | os.O_EXCL, 0o644), True
        except FileExistsError:
            return os.open(self._path, flags), False

    def _take(self) -> BaseFileLock | None:
        """Locks the file; None where it was another one than is there now.

        A file that is open keeps its number, and one that was removed never gets its name back: what has the name
        before and after was locked.
        """
        before, is_new = self._open()
        try:
            lock = FileLock(self._path, timeout=0, thread_local=False)
            try:
                lock.acquire()
            except Timeout:
                if not isinstance(lock, SoftFileLock) or not is_new:
                    raise
                self._path.unlink()  # the disk has no locks, and there the file itself is one
                lock.acquire()
            if isinstance(lock, SoftFileLock):
                return lock
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(before), os.stat(self._path)):
                    return lock
            lock.release()
            return None
        finally:
            os.close(before)
