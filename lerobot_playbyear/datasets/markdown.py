"""Names and texts of strangers in a card: shown as they are, never read as Markdown, HTML or a command."""

import re

from huggingface_hub.errors import HFValidationError
from huggingface_hub.utils import validate_repo_id

_SPECIAL = re.compile(r"([\\`*_\[\]<>|~&$#!:@]|(?<=www)\.)", re.IGNORECASE)
_NOT_PLAIN = re.compile(r"[^\w ,.;'?%()/+=-]|(?<=www)\.", re.IGNORECASE)


def text(value: str) -> str:
    """Words as words, on one line, also within a table."""
    return _SPECIAL.sub(r"\\\1", " ".join(value.split()))


def code(value: str) -> str:
    """A name between backticks, on one line, also within a table."""
    value = " ".join(value.split())
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", value)), default=0))
    space = " " if value.startswith("`") or value.endswith("`") or not value else ""
    return f"{fence}{space}{value}{space}{fence}".replace("|", "\\|")


def plain(value: str) -> str:
    """Words that mean nothing special, whether in Markdown, in HTML or between a shell's quotes; the rest is left out."""
    return " ".join(_NOT_PLAIN.sub(" ", value).split())


def word(value: str) -> str:
    """A name that may stand in a command without quotes."""
    return re.sub(r"[^\w.-]+", "_", value)


def repository_name(value: str | None) -> str | None:
    """The name of a repository, or None where it can be none."""
    try:
        validate_repo_id(value)
    except HFValidationError:
        return None
    return value
