"""An episode that goes to disk while it is played, so that a long one of large pictures needs no memory."""

import logging
import queue
import threading
import time
from typing import Any

import numpy as np

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.episodes.episode import Step
from lerobot_playbyear.episodes.frames import make_frame

_MOST_BYTES = 256 * 2**20  # that wait for the disk; a robot's loop that waits for more stands still, and holds
_MOST_PICTURES = 16  # of these in LeRobot's own queue, which has no bound; enough for its threads to be busy
_LOOK_S = 0.002


class FrameStream:
    """Takes the steps of an episode as they come, and adds them to a dataset in a thread of its own.

    Args:
        writer: Of the dataset.
        seed, task: As of `Episode`.

    Raises:
        DatasetWriteError: On the call after the disk did not take a frame.
    """

    def __init__(self, writer: DurableWriter, seed: int, task: str) -> None:
        self._writer, self._seed, self._task = writer, seed, task
        self._waiting: queue.Queue[dict[str, Any] | None] = queue.Queue()
        self._room = threading.Condition()
        self._n_bytes = 0
        self._error: BaseException | None = None
        self._is_abandoned = self._was_told = False
        self._thread = threading.Thread(target=self._write, name="frames", daemon=True)
        self._thread.start()

    def __call__(self, step: Step) -> None:
        """A step was made. Waits only where the disk, or what compresses pictures, is far behind, and says so once."""
        self._check()
        frame = make_frame(self._writer.features, step, self._seed, self._task)
        size = _size(frame)
        with self._room:
            if not self._has_room(size):
                self._tell()
                self._room.wait_for(lambda: self._has_room(size))
            self._n_bytes += size
        self._waiting.put(frame)

    def finish(self) -> None:
        """Returns when all frames are with the writer."""
        self._waiting.put(None)
        self._thread.join()
        self._check()

    def abandon(self) -> None:
        """What was added is forgotten."""
        self._is_abandoned = True
        self._waiting.put(None)
        self._thread.join()
        self._writer.discard_episode()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _has_room(self, size: int) -> bool:
        return self._n_bytes + size <= _MOST_BYTES or self._n_bytes == 0 or self._error is not None

    def _tell(self) -> None:
        if not self._was_told:
            self._was_told = True
            logging.warning(
                f"{self._n_bytes / 2**20:.0f} MiB of pictures wait to be compressed and written, and the robot waits with "
                f"them: {self._writer.root} takes them more slowly than they come. Encode video while recording "
                "(--dataset.video=true --dataset.streaming_encoding=true), or take smaller pictures, a lower --env.fps, or a "
                "faster disk."
            )

    def _write(self) -> None:
        while (frame := self._waiting.get()) is not None:
            try:
                if self._error is None and not self._is_abandoned:
                    self._writer.add_frame(frame)
                while self._writer.n_waiting > _MOST_PICTURES and not self._is_abandoned:
                    time.sleep(_LOOK_S)
            except Exception as error:  # told in the thread that plays
                self._error = error
            with self._room:
                self._n_bytes -= _size(frame)
                self._room.notify()


def _size(frame: dict[str, Any]) -> int:
    return sum(value.nbytes for value in frame.values() if isinstance(value, np.ndarray))
