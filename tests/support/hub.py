"""A Hub on loopback: an HTTP server that speaks the Hub's API to the real client, and fails as it is told.

Large files go up and down by git-lfs's basic transfer; clients have to be started with `HF_HUB_DISABLE_XET=1`.
"""

import base64
import contextlib
import hashlib
import itertools
import json
import random
import re
import socket
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

import yaml

TOKEN = "hf_loopback"
USER = "tester"
LARGE_SUFFIXES = (".parquet", ".safetensors", ".mp4", ".png")
"""Files that the Hub keeps apart from a commit's text, as its `.gitattributes` says."""

_REPO = r"(?P<kind>models|datasets)/(?P<name>[^/]+/[^/]+)"

Fault = Callable[[str, str], str | None]
"""Given method and path, what goes wrong: "unavailable" (status 503), "cut" (no answer, and nothing is done), "lost" (it is
done, and half of the answer arrives), "late" (status 504, and it is done when the next commit comes), or None."""


def nothing_fails(method: str, path: str) -> None:
    """All is well."""


def one_in(n: int, seed: int) -> Fault:
    """One request in n fails on average, in each of three ways alike."""
    rng = random.Random(seed)
    return lambda method, path: rng.choice(["unavailable", "cut", "lost"]) if rng.random() < 1 / n else None


def every_second(kind: str, method: str, pattern: str) -> Fault:
    """What goes wrong with the first, the third, ... request to the paths that match."""
    count = itertools.count()
    return lambda asked, path: kind if asked == method and re.search(pattern, path) and next(count) % 2 == 0 else None


# What a Hub keeps


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
            elif files.pop(value["path"], None) is None:  # "deletedFile"
                raise HubAnswerError(404, "EntryNotFound", "A file with this name doesn't exist")
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


# The server


@dataclass
class Answer:
    """What goes back: JSON, or `data`."""

    content: Any = None
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    data: bytes | None = None


class HubServer:
    """The Hub.

    Attributes:
        url: For `HF_ENDPOINT`.
        repositories: By (kind, name), kind "models" or "datasets".
        objects: Large files by their SHA-256.
        arrivals: How many times each large file came up as a whole.
        requests: Method, path and what went wrong, of every request.
        fault: Decides what goes wrong.
    """

    def __init__(self) -> None:
        self.repositories: dict[tuple[str, str], Repository] = {}
        self.objects: dict[str, bytes] = {}
        self.arrivals: Counter[str] = Counter()
        self.requests: list[tuple[str, str, str | None]] = []
        self.fault: Fault = nothing_fails
        self.lock = threading.Lock()
        self.late: list[Callable[[], Answer]] = []
        hub = self

        class Handler(_Handler):
            server_hub = hub

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.storage_url = f"http://localhost:{self.port}"  # another host, as the Hub's storage is

    def __enter__(self) -> "HubServer":
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def environment(self) -> dict[str, str]:
        """What makes a client come here."""
        return {"HF_ENDPOINT": self.url, "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}

    def dataset(self, name: str) -> Repository:
        return self.repositories["datasets", name]

    def model(self, name: str) -> Repository:
        return self.repositories["models", name]

    def faults(self) -> Counter[str]:
        """How often what went wrong."""
        return Counter(fault for _, _, fault in self.requests if fault)

    # Answers; each regular expression's groups and the request are the arguments

    def create(self, request: "_Handler") -> Answer:
        body = request.json()
        kind = f"{body.get('type') or 'model'}s"
        name = f"{body.get('organization') or USER}/{body['name']}"
        url = f"{self.url}/{'datasets/' if kind == 'datasets' else ''}{name}"
        if (kind, name) in self.repositories:
            return Answer({"error": "You already created this repo", "url": url}, 409)
        self.repositories[kind, name] = Repository(kind, name, body.get("visibility") == "private")
        return Answer({"url": url, "name": name})

    def validate_card(self, request: "_Handler") -> Answer:
        found = re.match(r"\s*---\n(.*?)\n---\n", request.json()["content"], re.DOTALL)
        data = yaml.safe_load(found[1]) if found else None
        if not isinstance(data, dict) or not isinstance(data.get("license"), str):
            return Answer({"errors": [{"message": "metadata with a license is wanted"}], "warnings": []}, 400)
        if not re.fullmatch(r"[a-z0-9.-]+", data["license"]):
            return Answer({"errors": [{"message": '"license" must be one of [apache-2.0, mit]'}], "warnings": []}, 400)
        return Answer({"errors": [], "warnings": []})

    def preupload(self, request: "_Handler", kind: str, name: str, revision: str) -> Answer:
        there = self._repository(kind, name).files(revision)
        files = [
            {
                "path": file["path"],
                "uploadMode": "lfs" if file["path"].endswith(LARGE_SUFFIXES) else "regular",
                "shouldIgnore": False,
                "oid": there[file["path"]].oid if file["path"] in there else None,
            }
            for file in request.json()["files"]
        ]
        return Answer({"files": files})

    def large_files(self, request: "_Handler", name: str) -> Answer:
        objects = []
        for wanted in request.json()["objects"]:
            entry = dict(wanted)
            if wanted["oid"] not in self.objects:
                entry["actions"] = {"upload": {"href": f"{self.storage_url}/storage/{wanted['oid']}"}}
            objects.append(entry)
        return Answer({"transfer": "basic", "objects": objects})

    def store(self, request: "_Handler", oid: str) -> Answer:
        self.objects[oid] = request.body
        self.arrivals[oid] += 1
        return Answer()

    def commit(self, request: "_Handler", kind: str, name: str, revision: str) -> Answer:
        lines = [json.loads(line) for line in request.body.splitlines()]
        oid = self._repository(kind, name).commit(revision, lines, self.objects)
        prefix = "datasets/" if kind == "datasets" else ""
        return Answer({"success": True, "commitOid": oid, "commitUrl": f"{self.url}/{prefix}{name}/commit/{oid}"})

    def tag(self, request: "_Handler", kind: str, name: str, revision: str) -> Answer:
        tags = self._repository(kind, name).tags
        if request.command == "DELETE":
            if tags.pop(revision, None) is None:
                raise HubAnswerError(404, "RevisionNotFound")
            return Answer({})
        tag = request.json()["tag"]
        if tag in tags:
            return Answer({"error": "Tag reference exists already"}, 409)
        tags[tag] = self._repository(kind, name).resolve(revision)
        return Answer({})

    def refs(self, request: "_Handler", kind: str, name: str) -> Answer:
        return Answer(self._repository(kind, name).refs())

    def info(self, request: "_Handler", kind: str, name: str, revision: str | None = None) -> Answer:
        return Answer(self._repository(kind, name).info(revision or "main"))

    def tree(self, request: "_Handler", kind: str, name: str, revision: str) -> Answer:
        files = self._repository(kind, name).files(revision)
        return Answer([file.describe(path) for path, file in sorted(files.items())])

    def file(self, request: "_Handler", name: str, revision: str, path: str, kind: str | None = None) -> Answer:
        repository = self._repository(kind or "models", name)
        commit = repository.resolve(revision)
        file = repository.commits[commit].get(path)
        if file is None:
            raise HubAnswerError(404, "EntryNotFound")
        headers = {"X-Repo-Commit": commit, "ETag": f'"{file.oid}"'}
        if not file.is_large:
            return request.part_of(file.data, headers)
        linked = {"X-Linked-Etag": f'"{file.oid}"', "X-Linked-Size": str(len(file.data))}
        return Answer(status=302, headers={**headers, **linked, "Location": f"{self.storage_url}/storage/{file.oid}"})

    def fetch(self, request: "_Handler", oid: str) -> Answer:
        return request.part_of(self.objects[oid], {"ETag": f'"{oid}"'})

    def whoami(self, request: "_Handler") -> Answer:
        return Answer({"type": "user", "name": USER, "orgs": [], "auth": {"type": "access_token"}})

    def _repository(self, kind: str, name: str) -> Repository:
        if (kind, name) not in self.repositories:
            raise HubAnswerError(404, "RepoNotFound")
        return self.repositories[kind, name]


_ROUTES: list[tuple[str, str, Callable[..., Answer]]] = [
    ("POST", r"/api/repos/create", HubServer.create),
    ("POST", r"/api/validate-yaml", HubServer.validate_card),
    ("GET", r"/api/whoami-v2", HubServer.whoami),
    ("POST", rf"/api/{_REPO}/preupload/(?P<revision>[^/]+)", HubServer.preupload),
    ("POST", rf"/api/{_REPO}/commit/(?P<revision>[^/]+)", HubServer.commit),
    ("POST DELETE", rf"/api/{_REPO}/tag/(?P<revision>[^/]+)", HubServer.tag),
    ("GET", rf"/api/{_REPO}/refs", HubServer.refs),
    ("GET", rf"/api/{_REPO}/tree/(?P<revision>[^/]+)", HubServer.tree),
    ("GET", rf"/api/{_REPO}(/revision/(?P<revision>[^/]+))?", HubServer.info),
    ("POST", r"/(datasets/)?(?P<name>[^/]+/[^/]+)\.git/info/lfs/objects/batch", HubServer.large_files),
    ("PUT", r"/storage/(?P<oid>\w+)", HubServer.store),
    ("GET HEAD", r"/storage/(?P<oid>\w+)", HubServer.fetch),
    (
        "GET HEAD",
        r"/((?P<kind>datasets)/)?(?P<name>[^/]+/[^/]+)/resolve/(?P<revision>[^/]+)/(?P<path>.+)",
        HubServer.file,
    ),
]

_FOR_WRITERS = (HubServer.create, HubServer.preupload, HubServer.commit, HubServer.tag, HubServer.large_files)


class _Handler(BaseHTTPRequestHandler):
    """Reads a request, lets go wrong what is to, and writes the Hub's answer."""

    protocol_version = "HTTP/1.1"
    server_hub: HubServer

    def do_GET(self) -> None:
        hub, path = self.server_hub, unquote(urlsplit(self.path).path)
        length = int(self.headers.get("Content-Length") or 0)
        with hub.lock:
            fault = hub.fault(self.command, path)
            hub.requests.append((self.command, path, fault))
        if fault == "cut":
            self.rfile.read(length // 2)
            return self._hang_up()
        self.body = (
            self._read_chunks() if "chunked" in self.headers.get("Transfer-Encoding", "") else self.rfile.read(length)
        )
        if len(self.body) < length:  # the client is gone
            return self._hang_up()
        if fault == "unavailable":
            return self._write(Answer(status=503, data=b"<html>The Hub is busy</html>"))
        with hub.lock:
            if fault == "late":
                hub.late.append(partial(self._answer, path))
                return self._write(Answer(status=504, data=b"<html>Gateway timeout</html>"))
            if self.command == "POST" and "/commit/" in path:
                while hub.late:
                    hub.late.pop()()
            answer = self._answer(path)
        self._write(answer, half=fault == "lost")

    do_HEAD = do_POST = do_PUT = do_DELETE = do_GET  # noqa: N815

    def log_message(self, *_: Any) -> None:
        """Says nothing."""

    def json(self) -> Any:
        return json.loads(self.body)

    def part_of(self, data: bytes, headers: dict[str, str]) -> Answer:
        """The bytes that the request asks for."""
        found = re.match(r"bytes=(\d+)-$", self.headers.get("Range", ""))
        if not found:
            return Answer(data=data, headers=headers)
        first = int(found[1])
        headers = {**headers, "Content-Range": f"bytes {first}-{len(data) - 1}/{len(data)}"}
        return Answer(data=data[first:], status=206, headers=headers)

    def _answer(self, path: str) -> Answer:
        for methods, pattern, method in _ROUTES:
            found = re.fullmatch(pattern, path)
            if found and self.command in methods.split():
                if method in _FOR_WRITERS and self.headers.get("Authorization") != f"Bearer {TOKEN}":
                    return Answer({"error": "Invalid username or password."}, 401)
                groups = {key: value for key, value in found.groupdict().items() if value is not None}
                try:
                    return getattr(self.server_hub, method.__name__)(self, **groups)
                except HubAnswerError as error:
                    headers = {"X-Error-Code": error.code, "X-Error-Message": error.message}
                    return Answer({"error": error.message}, error.status, headers)
        return Answer({"error": f"{self.command} {self.path} is not spoken here"}, 501)

    def _write(self, answer: Answer, half: bool = False) -> None:
        data = answer.data if answer.data is not None else json.dumps(answer.content).encode()
        self.send_response(answer.status)
        for name, value in answer.headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command == "HEAD":
            return None
        self.wfile.write(data[: len(data) // 2] if half else data)
        return self._hang_up() if half else None

    def _hang_up(self) -> None:
        self.close_connection = True
        with contextlib.suppress(OSError):  # the client hung up before
            self.connection.shutdown(socket.SHUT_RDWR)

    def _read_chunks(self) -> bytes:
        body = b""
        while size := int(self.rfile.readline(), 16):
            body += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return body
