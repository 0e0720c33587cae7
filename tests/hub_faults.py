"""What goes wrong at the Hub of `hub_server`."""

import itertools
import random
import re
from collections.abc import Callable

Fault = Callable[[str, str], str | None]
"""Given method and path, what goes wrong: "unavailable" (status 503), "cut" (no answer, and nothing is done), "lost" (it is
done, and half of the answer arrives), "late" (status 504, and it is done when the next commit comes), "slow", or
None."""


def nothing_fails(method: str, path: str) -> None:
    """All is well."""


def everything_fails(method: str, path: str) -> str:
    """There is no Hub."""
    return "cut"


def one_in(n: int, seed: int) -> Fault:
    """One request in n fails on average, in each of the four ways alike."""
    rng = random.Random(seed)
    return lambda method, path: rng.choice(["unavailable", "cut", "lost", "slow"]) if rng.random() < 1 / n else None


def down_after(n: int) -> Fault:
    """After n large files have come up there is no Hub any more."""
    count = itertools.count()
    is_down = False

    def fault(method: str, path: str) -> str | None:
        nonlocal is_down
        if method == "PUT" and not is_down:
            is_down = next(count) >= n
        return "cut" if is_down else None

    return fault


def every_second(kind: str, method: str, pattern: str) -> Fault:
    """What goes wrong with the first, the third, ... request to the paths that match."""
    count = itertools.count()
    return lambda asked, path: kind if asked == method and re.search(pattern, path) and next(count) % 2 == 0 else None
