"""Changes to a repository on the Hub that happen once, also when the Hub's answer to them is lost.

Of a request whose answer is lost nobody knows whether it was done. A repository that is there, or a tag that is there, is
what was wanted; a commit says which one it follows, so that the Hub refuses it where it has been made already.
"""

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, RepoCard, RepoUrl
from huggingface_hub.errors import RevisionNotFoundError

from lerobot_playbyear.hub.pushing import HubError, insist


def check_card(card: RepoCard, kind: str) -> None:
    """Asks the Hub whether it takes a card: of a commit it says so last, and `create_commit` says not why in one line.

    Args:
        card: The card.
        kind: "model" or "dataset".

    Raises:
        HubError: It does not, because of what the options say.
    """
    try:
        insist(lambda: card.validate(kind))
    except ValueError as error:
        said = " ".join(str(error).split())
        raise HubError(f"the Hub refuses its card, give another license or other tags: {said}") from error


class HubRepository:
    """One repository.

    Args:
        repo_id: Its name, `user/name`; without a user, the one who is logged in is its owner.
        kind: "model" or "dataset".
        private: Whether it is private if it is created. True: nothing goes to one that is there and public. None: as the
            account's default says.

    Raises:
        HubError: It has to be private, and is public.

    Attributes:
        url: Its address on the Hub.
        repo_id: Its name, with its owner's.
        api: The Hub.
    """

    def __init__(self, repo_id: str, kind: str, private: bool | None = None) -> None:
        self.api = HfApi()
        self._kind = kind
        self.url: RepoUrl = insist(
            lambda: self.api.create_repo(repo_id, repo_type=kind, private=private, exist_ok=True)
        )
        self.repo_id: str = self.url.repo_id
        if private and not insist(lambda: self.api.repo_info(self.repo_id, repo_type=kind)).private:
            raise HubError(
                f"private=true, but {self.url} is public. Make it private in its settings there, or leave the option out"
            )

    def commit(self, files: Mapping[str, Path], message: str, is_stale: Callable[[str], bool] | None = None) -> str:
        """Makes one commit, or none where all is there already.

        `HfApi.upload_folder` may make several, and repeats one whose answer is lost.

        Args:
            files: What to upload, by the names there.
            message: Of the commit.
            is_stale: Whether a file of the repository, by its name, goes unless it is among `files`. None: none goes.

        Returns:
            The name of the newest commit, which has the files.
        """
        return insist(lambda: self._commit(files, message, is_stale))

    def _commit(self, files: Mapping[str, Path], message: str, is_stale: Callable[[str], bool] | None) -> str:
        """One attempt: what an earlier one has done is found done, or being done meanwhile makes the Hub refuse this one."""
        head = self.api.repo_info(self.repo_id, repo_type=self._kind, revision="main").sha
        operations: list[CommitOperationAdd | CommitOperationDelete] = [
            CommitOperationAdd(name, path) for name, path in files.items()
        ]
        if is_stale is not None:
            there = self.api.list_repo_files(self.repo_id, repo_type=self._kind, revision=head)
            stale = [name for name in there if is_stale(name) and name not in files]
            operations += [CommitOperationDelete(name, is_folder=False) for name in stale]
        commit = self.api.create_commit(
            self.repo_id, operations, repo_type=self._kind, commit_message=message, parent_commit=head
        )
        return str(commit.oid)

    def set_tag(self, tag: str, commit: str | None = None, move: bool = False) -> None:
        """Gives a commit a name; one that is there already stays where it is, unless it is to move.

        Args:
            tag: The name.
            commit: The commit. None: the newest.
            move: Take the name from the commit that has it.
        """
        if move:
            with contextlib.suppress(RevisionNotFoundError):
                insist(lambda: self.api.delete_tag(self.repo_id, tag=tag, repo_type=self._kind))
        insist(lambda: self.api.create_tag(self.repo_id, tag=tag, revision=commit, repo_type=self._kind, exist_ok=True))
