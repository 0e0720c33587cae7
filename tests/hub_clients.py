"""Runs a command, and says whether `huggingface_hub` has the same client afterwards.

hub-clients lerobot-train --help
"""

import importlib
import sys

from huggingface_hub.utils import _http, get_async_session, get_session


def main() -> None:
    from hub_client import COMMANDS

    before = _clients()
    sys.argv = sys.argv[1:]
    try:
        importlib.import_module(COMMANDS[sys.argv[0]]).main()
    except SystemExit as end:
        print(f"exit status {end.code}")
    finally:
        plugin = "is" if "lerobot_policy_playbyear" in sys.modules else "is not"
        same = "the same" if _clients() == before else "another"
        print(f"the plugin {plugin} there, and huggingface_hub has {same} client")


def _clients() -> tuple[object, ...]:
    factories = _http._GLOBAL_CLIENT_FACTORY, _http._GLOBAL_ASYNC_CLIENT_FACTORY
    return *factories, get_session(), type(get_async_session())
