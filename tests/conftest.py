"""Fixtures of several test modules, and a failure told when it happens."""

import pytest


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
