"""Fixtures of several test modules."""

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
