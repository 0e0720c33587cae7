"""At most one process works in the output folder of a run."""

import contextlib
import logging
from pathlib import Path

from filelock import FileLock, Timeout

from lerobot_playbyear.datasets.errors import InputError

LOCK = ".lock"
"""File in the output folder while a run is at work."""


class RunLock:
    """Held from its making until `release`, or the end of the process, however it ends.

    Args:
        folder: The output folder; made where it is missing.

    Raises:
        InputError: Another process holds it.
    """

    def __init__(self, folder: Path) -> None:
        self._is_new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / LOCK
        self._lock = FileLock(self._path, timeout=0, thread_local=False)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise InputError(
                f"--output_dir={folder}: another playbyear-dagger is at work there. Wait until it has ended, or choose another "
                f"folder. If none is, on a disk without locks, remove {self._path}."
            ) from error
        except OSError as error:
            logging.warning(f"{folder} cannot be locked ({error}): let no other playbyear-dagger work there.")

    def release(self) -> None:
        """Lets go, and leaves nothing behind: also no folder, of a run that never began."""
        with contextlib.suppress(OSError):  # Windows removes no open file
            self._path.unlink()
        self._lock.release()
        if self._is_new:
            with contextlib.suppress(OSError):
                self._path.parent.rmdir()
