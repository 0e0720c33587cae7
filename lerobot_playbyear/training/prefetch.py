"""Batches that are ready when they are wanted."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from torch import Tensor

_AHEAD = 2


def prefetched(make_batch: Callable[[], dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Makes batches in a thread, two ahead of the one that is learned from, in the order of the calls.

    Raises:
        Exception: What `make_batch` raises, when its batch is wanted.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="batches")
    try:
        waiting = deque(pool.submit(make_batch) for _ in range(_AHEAD))
        while True:
            waiting.append(pool.submit(make_batch))
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def pinned(batch: Mapping[str, Any]) -> dict[str, Any]:
    """The batch in memory that a GPU reads by itself, so that copying it holds up nothing."""
    return {key: value.pin_memory() if isinstance(value, Tensor) else value for key, value in batch.items()}
