"""Uploads: their steps repeated while the Hub fails for a passing reason, and what to do when it does not come back."""

import json
import logging
import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
from huggingface_hub import constants, get_token
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, OfflineModeIsEnabled
from huggingface_hub.utils import validate_repo_id

from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.hub.client import patient_hub

_WAITS_S = (1, 2, 5)
_PASSING = (408, 409, 412, 425, 429)  # besides all from 500; 412: a newer commit came before this one

logger = logging.getLogger(__name__)


class HubError(PlaybyearError, RuntimeError):
    """Nothing was uploaded, or not all; the message says why, and how to go on."""


@dataclass
class PushOptions:
    """How something is uploaded.

    Args:
        private: Whether a repository that is created is private. True: nothing goes to one that is there and public. None: as
            the account's default says.
        tags: For the card, besides those that it gets by itself.
        license: As the Hub names licences. None: the policy's own, or else apache-2.0.
        preview: An mp4 that the card shows, as `playbyear-video` makes them. None: of a dataset, one is made.
    """

    private: bool | None = None
    tags: list[str] | None = None
    license: str | None = None
    preview: Path | None = None

    def check(self) -> None:
        """Raise a HubError if there is no such film."""
        if self.preview is not None and not self.preview.is_file():
            raise HubError(f"preview={self.preview}: there is no such file.")
        if self.preview is not None and self.preview.suffix.lower() != ".mp4":
            raise HubError(f"preview={self.preview}: cards show mp4; give a film as playbyear-video makes them.")

    def on_command_line(self) -> list[str]:
        """As `playbyear-push` takes them."""
        private = None if self.private is None else str(self.private).lower()
        tags = f"[{','.join(self.tags)}]" if self.tags else None
        given = {"private": private, "tags": tags, "license": self.license, "preview": self.preview}
        return [f"--{name}={value}" for name, value in given.items() if value is not None]


def push_patiently(push: Callable[[], str], what: str, later: list[str], options: PushOptions) -> str:
    """Uploads something.

    Args:
        push: Uploads it, in steps that `insist`. Called again later, it sends what has not arrived.
        what: Where it is safe on this machine, "The dataset is complete in outputs/demo".
        later: The options that name it for `playbyear-push`.
        options: Further ones.

    Returns:
        What `push` returns: its address on the Hub.

    Raises:
        HubError: The Hub cannot be reached, or refuses.
    """
    try:
        with patient_hub():
            return push()
    except Exception as error:  # whatever the client, its Rust extension or the file system raise
        command = ["playbyear-push", *later, *options.on_command_line()]
        raise HubError(
            f"{what}, but it could not be uploaded: {reason(error)}. Upload it later with\n"
            f"  {shlex.join(command)}\nwhich does not send again what has arrived."
        ) from error


def insist[T](step: Callable[[], T]) -> T:
    """Does a step of an upload again while it fails for a passing reason.

    Args:
        step: Something that can be done twice: its failure does not tell whether it was done.
    """
    waits = list(_WAITS_S)
    while True:
        try:
            return step()
        except Exception as error:  # as in `push_patiently`
            if not waits or not _is_passing(error):
                raise
            logger.warning("The Hub failed (%s); once more in %d s", reason(error), waits[0])
        time.sleep(waits.pop(0))


def push_meanwhile(push: Callable[[], object], path: Path) -> None:
    """Uploads something in the middle of work, which a Hub that cannot be reached must not end.

    Args:
        push: Uploads it.
        path: Where it is safe on this machine.
    """
    try:
        with patient_hub():
            push()
    except Exception as error:  # as in `push_patiently`
        logger.warning("%s was not uploaded (%s). Work goes on without", path, reason(error))


def reason(error: BaseException) -> str:
    """Why the Hub could not be used, in one line."""
    for cause in _causes(error):
        if isinstance(cause, HubError):
            return str(cause).rstrip(".")
        if isinstance(cause, OfflineModeIsEnabled):
            return "the environment variable HF_HUB_OFFLINE forbids it"
        if isinstance(cause, HfHubHTTPError):
            status, said = cause.response.status_code, (cause.server_message or "").partition("\n")[0].rstrip(".")
            if status == 403 and said and get_token():  # it may be a quota
                return (
                    f"{constants.ENDPOINT} refused (status 403): {said}. If that is about the token, log in with "
                    "`hf auth login`, with one that may write there"
                )
            if status in (401, 403):
                return (
                    f"{constants.ENDPOINT} refused (status {status}): log in with `hf auth login`, with a token that may "
                    "write there"
                )
            return f"{constants.ENDPOINT} answered: {_first_line(cause)}"
        if isinstance(cause, httpx.TransportError):
            return f"{constants.ENDPOINT} cannot be reached ({type(cause).__name__}: {_first_line(cause)})"
    return f"{type(error).__name__}: {_first_line(error)}"


def check_name(option: str, repo_id: str, needs_user: bool = False) -> None:
    """Whether there can be a repository of a name on the Hub.

    Args:
        option: What the name was given with, such as "policy.repo_id", for the message.
        repo_id: The name, `user/name`.
        needs_user: Whether the user's name may not be left out.

    Raises:
        HubError: There can be none.
    """
    if needs_user and "/" not in repo_id:
        raise HubError(f"{option}={repo_id!r}: to push, give it as user/name.")
    try:
        validate_repo_id(repo_id)
    except HFValidationError as error:
        raise HubError(f"{option}={repo_id!r} cannot be pushed: {_first_line(error)}.") from error


def warn_without_login() -> None:
    """Says before long work that its upload will fail, so that there is time to log in."""
    if not get_token():
        logger.warning("Nobody is logged in to the Hub: log in with `hf auth login` before the upload at the end.")


def _is_passing(error: BaseException) -> bool:
    for cause in _causes(error):
        if isinstance(cause, OfflineModeIsEnabled):
            return False
        if isinstance(cause, HfHubHTTPError):
            return cause.response.status_code in _PASSING or cause.response.status_code >= 500
        if isinstance(cause, httpx.TransportError | json.JSONDecodeError):
            return True
    return type(error) is RuntimeError  # hf_xet's, for want of a better one


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__


def _first_line(error: BaseException) -> str:
    return next((line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()), type(error).__name__)
