"""Calls that fail when a test wants them to."""

import itertools
from collections.abc import Iterator
from typing import Any


class PowerCut(BaseException):
    """Stops what runs at a chosen moment, so that no clean-up of its own runs."""


def fail_once(patch: Any, owner: Any, name: str, after: int, error: Any = PowerCut) -> Iterator[int]:
    """Lets `owner.name` work `after` times; the next call raises `error` before it does anything, and all others work.

    Returns what counts the calls: its next value is how many there were.
    """
    calls, real = itertools.count(), getattr(owner, name)

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        if next(calls) == after:
            raise error
        return real(*args, **kwargs)

    patch.setattr(owner, name, wrapped)
    return calls
