"""Commands as they are typed, in a tenth of a second: every command is a fork of a process that has LeRobot.

That process is a fork of the one that runs the tests, from before the first: what tests import is imported once. Each command
has its own arguments, environment, output and exit status. What is read while modules are imported, such as `HF_ENDPOINT` and
`HF_HOME`, is that of the tests; `conftest.py` sets it.
"""

import contextlib
import gc
import importlib
import inspect
import logging
import multiprocessing
import os
import pkgutil
import shutil
import signal
import ssl
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

_COMMANDS = {
    entry.name: entry
    for entry in metadata.entry_points(group="console_scripts")
    if entry.name.startswith(("playbyear-", "lerobot-"))
}
_BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"blocked: {{name}}")

sys.meta_path.insert(0, Blocker())
"""
_IMPORTED = (
    "lerobot.scripts.lerobot_train",
    "lerobot.scripts.lerobot_eval",
    "lerobot_env_playbyear",
    "gym_playbyear.environment",
)


@dataclass
class Result:
    """Of a command: its exit status, negative if a signal ended it, and what it printed."""

    status: int
    output: str


class Commands:
    """Runs commands. Make it before any test has run.

    Args:
        home: Of the caches, `HF_HOME`, and the output.
    """

    def __init__(self, home: Path) -> None:
        self._home, self._output = home, home / "output"
        self._server, theirs = multiprocessing.Pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of threads: none of them is at work yet
            self._pid = os.fork()
        if self._pid == 0:
            self._server.close()
            try:
                _serve(theirs)
            finally:
                os._exit(0)
        theirs.close()

    def run(
        self,
        *arguments: str | Path,
        fresh: bool = True,
        environment: Mapping[str, str] | None = None,
        kill_when: Callable[[], bool] | None = None,
    ) -> Result:
        """Run a command.

        Args:
            arguments: Its name and its options.
            fresh: Whether it begins without anything from the Hub in its caches.
            environment: For this command alone. It also finds distributions, with their tasks, on a `PYTHONPATH` in it.
            kill_when: The command is killed when this becomes true.
        """
        for name in ("hub", "lerobot") if fresh else ():
            shutil.rmtree(self._home / name, ignore_errors=True)
        self._server.send(([*map(str, arguments)], dict(environment or {}), os.getcwd(), self._output))
        pid = self._server.recv()
        done = threading.Event()
        if kill_when is not None:
            threading.Thread(target=_kill, args=(pid, kill_when, done), daemon=True).start()
        status = self._server.recv()
        done.set()
        return Result(status, self._output.read_text())

    def succeed(self, *arguments: str | Path, **how: Any) -> Result:
        """Run a command that has to end well."""
        result = self.run(*arguments, **how)
        assert result.status == 0, result.output[-3000:]
        return result

    def snapshot(self, repo_id: str) -> Path:
        """Where LeRobot has put a dataset that it fetched."""
        (folder,) = (self._home / "lerobot" / "hub" / f"datasets--{repo_id.replace('/', '--')}" / "snapshots").iterdir()
        return folder

    def close(self) -> None:
        self._server.close()
        os.waitpid(self._pid, 0)


def python(code: str, *arguments: str, environment: Mapping[str, str] = os.environ) -> str:
    """What a program prints that is a process of its own."""
    command, own = [sys.executable, "-c", code, *arguments], dict(environment)
    result = subprocess.run(command, capture_output=True, text=True, env=own, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def run_without(blocked: set[str], code: str) -> str:
    """What a program prints in a process in which some packages cannot be imported."""
    return python(_BLOCKER.format(blocked=blocked) + code, environment={**os.environ, "MUJOCO_GL": "egl"})


def _kill(pid: int, when: Callable[[], bool], done: threading.Event) -> None:
    while not done.wait(0.005):
        if when():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            return


def _serve(connection: Connection) -> None:
    logging.getLogger().handlers.clear()  # pytest's
    prepare = cache(_prepare)
    with contextlib.suppress(EOFError):  # the tests have ended
        while True:
            job = connection.recv()
            prepare()
            pid = os.fork()
            if pid == 0:
                _run(*job)
            connection.send(pid)
            connection.send(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))


def _prepare() -> None:
    package = importlib.import_module("lerobot_playbyear")
    ours = [module.name for module in pkgutil.walk_packages(package.__path__, "lerobot_playbyear.")]
    for module in (*_IMPORTED, *ours):
        with contextlib.suppress(ImportError):  # of what needs a sound card or a window
            importlib.import_module(module)
    importlib.import_module("torch").set_num_threads(1)
    _check_cards_there()
    _read_options()


def _check_cards_there() -> None:
    """`RepoCard.validate`, as LeRobot calls it, asks huggingface.co whatever `HF_ENDPOINT` says."""
    from huggingface_hub import HfApi, RepoCard

    RepoCard.validate = lambda card, repo_type=None: HfApi()._validate_yaml(
        str(card), repo_type=repo_type or card.repo_type
    )


def _read_options() -> None:
    import httpx
    from draccus import argparsing
    from lerobot.utils import import_utils

    sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
    from list_options import CONFIGS  # type: ignore[import-not-found]

    speed_up()
    ssl.create_default_context = cache(ssl.create_default_context)  # it reads all certificates, for every client
    httpx.create_ssl_context()
    import_utils.register_third_party_plugins()
    for config in CONFIGS.values():
        argparsing.ArgumentParser(config)
    gc.collect()
    gc.freeze()


def speed_up() -> None:
    """What commands take longest for is done once a process: a parser of 2,000 options, whose help draccus searches the sources
    for, and to look for plugins in the metadata of all distributions.

    And a column that is added to a table's features is looked at alone: datasets looks at all others again.
    """
    from datasets.features import features
    from draccus import argparsing
    from draccus.choice_types import ChoiceRegistryBase
    from draccus.wrappers import docstring, field_wrapper
    from lerobot.utils import import_utils

    from gym_playbyear import registry

    docstring._get_class_source = cache(docstring._get_class_source.__wrapped__)  # it has room for 100 classes
    docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
    field_wrapper.inspect = SimpleNamespace(getfullargspec=cache(inspect.getfullargspec))
    new_parser = cache(
        lambda n_choices, config, exits, make=argparsing.ArgumentParser: make(config, exit_on_error=exits)
    )

    def parser_of(config_class: type, config_path: Any = None, exit_on_error: bool = True, **_: Any) -> Any:
        known = [getattr(kind, "_choice_registry", ()) for kind in _below(ChoiceRegistryBase)]
        parser = new_parser(sum(map(len, known)), config_class, exit_on_error)  # another one when there are more
        parser.config_path, parser.parser.prog = config_path, Path(sys.argv[0]).name
        return parser

    argparsing.ArgumentParser = parser_of
    for module, name in ((import_utils, "register_third_party_plugins"), (registry, "entry_points")):
        setattr(module, name, _once_for_each_path(getattr(module, name)))

    def set_column(self: Any, name: str, feature: Any) -> None:
        dict.__setitem__(self, name, feature)
        self._column_requires_decoding[name] = features.require_decoding(feature)

    features.Features.__setitem__ = set_column


def _below(kind: type) -> Iterator[Any]:
    for below in kind.__subclasses__():
        yield from (below, *_below(below))


def _once_for_each_path(search: Callable[..., Any]) -> Callable[..., Any]:
    """What this finds in the distributions on a path."""
    found = cache(lambda path, **what: search(**what))
    return lambda **what: found(tuple(sys.path), **what)


def _run(arguments: list[str], environment: dict[str, str], folder: str, output: Path) -> None:
    """Never returns."""
    status = 0
    os.environ.update(environment)
    os.chdir(folder)
    if "PYTHONPATH" in environment:
        sys.path[:0] = environment["PYTHONPATH"].split(os.pathsep)
        importlib.import_module("gym_playbyear").register_tasks()
    with output.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    for logger in logging.root.manager.loggerDict.values():
        for handler in getattr(logger, "handlers", ()):
            if isinstance(handler, logging.StreamHandler):
                handler.setStream(sys.stderr)  # it has that of the tests
    sys.argv = arguments
    try:
        _COMMANDS[sys.argv[0]].load()()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else 0 if error.code is None else 1
        if isinstance(error.code, str):
            print(error.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
