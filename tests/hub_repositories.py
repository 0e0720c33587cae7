"""What a Hub keeps: repositories with commits, branches and tags, and the large files that commits point to."""

import base64
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

LARGE_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".png")
"""Files that the Hub keeps apart from a commit's text, as its `.gitattributes` says."""


class HubAnswerError(Exception):
    """The request is answered with an error.

    Args:
        status: HTTP status.
        code: The header `X-Error-Code`, from which the client makes its exceptions.
        message: For a person.
    """

    def __init__(self, status: int, code: str = "", message: str = "") -> None:
        super().__init__(message or code)
        self.status, self.code, self.message = status, code, message or code


@dataclass(frozen=True)
class File:
    """A file of a commit: `oid` is the SHA-256 of a large one, and git's SHA-1 of another."""

    oid: str
    data: bytes
    is_large: bool

    def describe(self, path: str) -> dict[str, Any]:
        facts: dict[str, Any] = {"type": "file", "path": path, "size": len(self.data), "oid": self.oid}
        if self.is_large:
            facts["oid"] = git_oid(self.oid.encode())  # of the pointer
            facts["lfs"] = {"oid": self.oid, "size": len(self.data), "pointerSize": 134}
        return facts


@dataclass
class Repository:
    """One repository; `commits` maps each commit to its files."""

    kind: str
    name: str
    private: bool = False
    commits: dict[str, dict[str, File]] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.branches["main"] = self._add_commit({}, "initial commit")

    def resolve(self, revision: str) -> str:
        """The commit that a branch, a tag or a commit's name means."""
        commit = self.branches.get(revision) or self.tags.get(revision) or revision
        if commit not in self.commits:
            raise HubAnswerError(404, "RevisionNotFound")
        return commit

    def files(self, revision: str = "main") -> dict[str, File]:
        return self.commits[self.resolve(revision)]

    def commit(self, branch: str, lines: list[dict[str, Any]], objects: dict[str, bytes]) -> str:
        """Apply the lines of a commit's body; all of it or nothing."""
        if branch not in self.branches:
            raise HubAnswerError(404, "RevisionNotFound")
        files = dict(self.files(branch))
        message = ""
        for line in lines:
            key, value = line["key"], line["value"]
            if key == "header":
                message = value["summary"]
                if value.get("parentCommit", self.branches[branch]) != self.branches[branch]:
                    raise HubAnswerError(412, message="A commit has happened since. Please refresh and try again.")
            elif key == "file":
                data = base64.b64decode(value["content"])
                files[value["path"]] = File(git_oid(data), data, is_large=False)
            elif key == "lfsFile":
                if value["oid"] not in objects:
                    raise HubAnswerError(400, message=f"{value['path']} was never uploaded")
                files[value["path"]] = File(value["oid"], objects[value["oid"]], is_large=True)
            elif key == "deletedFile":
                if files.pop(value["path"], None) is None:
                    raise HubAnswerError(404, "EntryNotFound", "A file with this name doesn't exist")
            else:
                raise HubAnswerError(400, message=f"unknown line {key}")
        self.branches[branch] = self._add_commit(files, message)
        return self.branches[branch]

    def info(self, revision: str) -> dict[str, Any]:
        commit = self.resolve(revision)
        siblings = [{"rfilename": path} for path in self.commits[commit]]
        return {"id": self.name, "sha": commit, "private": self.private, "tags": [], "siblings": siblings}

    def refs(self) -> dict[str, Any]:
        def named(refs: dict[str, str], folder: str) -> list[dict[str, str]]:
            return [{"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": c} for name, c in refs.items()]

        return {"branches": named(self.branches, "heads"), "tags": named(self.tags, "tags"), "converts": []}

    def _add_commit(self, files: dict[str, File], message: str) -> str:
        content = {path: file.oid for path, file in sorted(files.items())}
        oid = hashlib.sha1(json.dumps([len(self.commits), self.name, content]).encode()).hexdigest()
        self.commits[oid] = files
        self.messages.append(message)
        return oid


def git_oid(data: bytes) -> str:
    """The name that git gives to a file."""
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
