"""A question at the terminal, which may have other readers."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

READERS: list[Callable[[], AbstractContextManager[None]]] = []
"""What reads keys from the terminal meanwhile, each as a context in which it does not."""


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """A context in which what is typed is for whoever asks in it."""
    with contextlib.ExitStack() as stack:
        for reader in READERS:
            stack.enter_context(reader())
        yield


def ask(why: str, question: str) -> str | None:
    """Asks the person at the terminal; what is typed meanwhile is for the question alone.

    Args:
        why: Printed before it.
        question: To be answered by a line.

    Returns:
        The answer, or None where nobody is there.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        return None
    print(f"\n{why}", file=sys.stderr)
    with alone():
        try:
            return input(question)
        except EOFError:
            return None
