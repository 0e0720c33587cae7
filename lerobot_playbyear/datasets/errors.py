"""What can go wrong through no fault of the program. Commands say it in one line."""

from collections.abc import Iterator
from contextlib import contextmanager


class PlaybyearError(Exception):
    """Something that was asked for cannot be done; the message says why, and what to do.

    Any other error is a fault of the program, and a command that ends with one shows where it happened.
    """


class InputError(PlaybyearError, ValueError):
    """Options, data, policy or environment cannot be used, or do not go together."""


class DatasetWriteError(PlaybyearError, RuntimeError):
    """An episode could not be written; the episodes saved before it are complete on disk."""


def first_line(error: BaseException) -> str:
    """The first line of what an error says, without a full stop; its type where it says nothing."""
    return next((line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()), type(error).__name__)


def printable(text: object, kept: str = "\n\t") -> str:
    """For a terminal: what would command it, in a name of a stranger's, is shown as an escape, but for what is kept."""
    return "".join(letter if letter.isprintable() or letter in kept else repr(letter)[1:-1] for letter in str(text))


@contextmanager
def errors_of_input(*more: type[Exception]) -> Iterator[None]:
    """For the time in which options and data are read: what is raised of some kinds says what is wrong with them.

    Args:
        more: Kinds other than `ValueError` and `FileExistsError`.

    Raises:
        InputError: In place of these.
    """
    kinds: tuple[type[Exception], ...] = (ValueError, FileExistsError, *more)
    try:
        yield
    except PlaybyearError:
        raise
    except kinds as error:
        raise InputError(str(error)) from error
