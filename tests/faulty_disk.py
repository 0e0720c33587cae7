"""A disk that fails for a moment: any one call below a folder ends with an error of the operating system, once.

The error is made below Python's `open`, by a library that is preloaded, so that Arrow and FFmpeg meet it, too.
"""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

READS, WRITES = 1, 2
ERRORS = {
    READS: (errno.EIO, errno.ESTALE, errno.ENOMEM, errno.EACCES),
    WRITES: (errno.EIO, errno.ESTALE, errno.ENOMEM, errno.ENOSPC),
}
_HERE = Path(__file__).parent
_CONTROL_BYTES = 4096


class FaultyDisk:
    """A process that does things with datasets while the disk fails.

    Args:
        folder: For the library and what it is told.
    """

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if sys.platform != "linux" or compiler is None:
            pytest.skip("faults of the disk are made by a preloaded library: this needs Linux and a C compiler")
        library, control = folder / "fault_shim.so", folder / "control"
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, _HERE / "fault_shim.c", "-ldl"], check=True)
        control.write_bytes(bytes(_CONTROL_BYTES))
        environment = {
            **os.environ,
            "LD_PRELOAD": str(library),
            "FAULT_CONTROL": str(control),
            "HF_HUB_OFFLINE": "1",
            "PYTHONPATH": os.pathsep.join([str(_HERE), *filter(None, [os.environ.get("PYTHONPATH")])]),
        }
        command = [sys.executable, str(_HERE / "faulty_forks.py")]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=(folder / "said").open("w"),
            text=True,
            env=environment,
        )
        assert self._answer() == {"ready": True}, (folder / "said").read_text()

    def run(self, operation: str, root: Path, *, at: int = -1, error: int = 0, kinds: int = READS) -> dict[str, Any]:
        """Does one thing with the dataset in `root`, in a process of its own.

        Args:
            operation: One of `faulty_forks.OPERATIONS`.
            root: The dataset's folder.
            at: Which of the calls below the folder's parent fails; -1: none.
            error: With which error.
            kinds: Which calls are counted: `READS`, `WRITES` or both.

        Returns:
            What it said, or its `error`; the number of `calls`, and the one that `failed`.
        """
        order = {"operation": operation, "root": str(root), "folder": str(root.parent)}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({**order, "at": at, "error": error, "kinds": kinds}) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline() or "{}")
