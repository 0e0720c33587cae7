"""Fixtures of several test modules, and a failure told when it happens."""

import gc
import logging
import os
import tempfile
from pathlib import Path

import pytest
from support import shared
from support.commands import Commands, speed_up
from support.hub import HubServer, nothing_fails

os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())  # where pytest keeps the last tests' folders
HUB, HOME = HubServer(), tempfile.TemporaryDirectory(prefix="playbyear-")
os.environ.update(HUB.environment(), HF_HOME=HOME.name)  # before anything is imported that reads it
os.environ.update(TMPDIR=HOME.name, PULSE_RUNTIME_PATH=f"{HOME.name}/pulse")
tempfile.tempdir = HOME.name  # what LeRobot, or a test that is killed, leaves there goes with the tests


@pytest.fixture(scope="session", autouse=True)
def _parsers_are_quick():
    """A command builds its parser whenever it starts: here several hundred times."""
    logging.getLogger("draccus").setLevel(logging.INFO)  # else as many lines of what it decodes are kept for each test
    speed_up()


@pytest.fixture(scope="module")
def one_thread():
    """Networks this small only lose by waking threads. LeRobot knows all plugins, as when any command has started."""
    import torch
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(n_threads)


@pytest.fixture(scope="session", autouse=True)
def _one_folder_for_all_processes(tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    shared.FOLDER = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session")
def noise() -> Path:
    """A dataset of noise with sound, 20 Hz and pictures of 16 pixels: episodes of 12, 17 and 9 frames. Copy it to change it."""
    from dataset_factory import make_dataset

    return shared.once("noise", lambda root: make_dataset(root, image_size=16))


@pytest.fixture(scope="session")
def silent() -> Path:
    """The same without sound."""
    from dataset_factory import make_dataset

    return shared.once("silent", lambda root: make_dataset(root, repo_id="test/silent", image_size=16, microphones=()))


@pytest.fixture(scope="session")
def recorded() -> Path:
    return shared.recorded()


@pytest.fixture(scope="session")
def trained() -> Path:
    return shared.trained()


@pytest.fixture(scope="session")
def finished() -> Path:
    """The folder of a run of HG-DAgger that ended: `out` and `corrections`. Copy it to change it."""
    from dagger_factory import finished

    return finished()


@pytest.fixture(scope="session", autouse=True)
def hub_server():
    """The Hub, on loopback."""
    with HUB:
        yield HUB


@pytest.fixture
def hub(hub_server):
    """The Hub, to which nothing has come yet in this test, and where nothing fails."""
    hub_server.arrivals.clear()
    hub_server.requests.clear()
    yield hub_server
    hub_server.fault = nothing_fails


@pytest.fixture
def here(hub, monkeypatch):
    """The same for this process, which checks no cards: the client asks huggingface.co."""
    monkeypatch.setattr("huggingface_hub.RepoCard.validate", lambda card, repo_type=None: None)
    return hub


@pytest.fixture(scope="session")
def commands(request):
    """Runs commands as they are typed, each in a process of its own; see `support/commands.py`."""
    yield request.config.commands
    request.config.commands.close()


def pytest_collection_finish():
    """What was imported stays: the garbage collector need not look through PyTorch and LeRobot again and again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    if any("commands" in item.fixturenames for item in session.items):
        session.config.commands = Commands(Path(HOME.name))


class ToldAtOnce:
    """Prints the end of each failure as it comes: a run that is stopped later never prints its summary."""

    def __init__(self, terminal):
        self.terminal = terminal

    def pytest_runtest_logreport(self, report):
        if report.failed:
            told = report.longreprtext.splitlines()[-12:]
            self.terminal.write_line("\n".join(["", f"{report.when} of {report.nodeid} failed:", *told]))


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(ToldAtOnce(terminal))
