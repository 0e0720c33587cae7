"""What is borrowed from the inside of LeRobot and torch is there, and borrowed in one place: a new version fails here first."""

import ast
from pathlib import Path

import pytest
import torch

from lerobot_playbyear import compat
from lerobot_playbyear.compat import BORROWED, Borrowed, CompatError

ROOT = Path(__file__).parent.parent
PACKAGES = (ROOT / "lerobot_playbyear", ROOT / "envs")
OURS = [path for folder in PACKAGES for path in sorted(folder.rglob("*.py")) if path.name != "compat.py"]
INSIDE = ("lerobot.scripts", "lerobot.common")
OWN = {
    "_asked_dtype",  # of our own configuration
    "_max_episode_steps",  # of our own environments, where LeRobot asks for it
    "_exit",  # of the standard library, documented
}


@pytest.mark.parametrize("name", BORROWED)
def test_what_is_borrowed_is_there(name):
    if "mkldnn" in BORROWED[name].where and not torch.backends.mkldnn.is_available():
        pytest.skip("this build of torch has no oneDNN, and the policy does without")
    BORROWED[name].load()


@pytest.mark.parametrize(
    ("gone", "what"),
    [
        (
            Borrowed("lerobot.policies.elsewhere:make", "lerobot 0.6.1", "nothing works"),
            "there is no lerobot.policies.else",
        ),
        (
            Borrowed("lerobot.policies:make_nothing", "lerobot 0.6.1", "nothing works"),
            "there is no lerobot.policies:make_n",
        ),
        (
            Borrowed("lerobot.policies.factory:make_policy", "lerobot 0.6.1", "nothing works", says="self._else"),
            "make_policy does nothing with `self._else`",
        ),
    ],
)
def test_what_is_gone_is_missed_with_a_sentence(gone, what):
    with pytest.raises(
        CompatError, match=rf"In lerobot [\d.]+ .*{what}.* in lerobot 0\.6\.1\. Without it: nothing works"
    ):
        gone.load()


def test_functions_are_imported_by_their_name():
    from lerobot.scripts.lerobot_train import update_policy

    assert compat.update_policy is update_policy
    with pytest.raises(ImportError, match="cannot import name 'update_polic'"):
        from lerobot_playbyear.compat import update_polic  # noqa: F401


def test_nothing_is_borrowed_elsewhere():
    """Neither from LeRobot's commands, nor private names of modules and objects that are not one's own."""
    found = []
    for path in OURS:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                module, names = node.module or "", [alias.name for alias in node.names]
                if module.startswith(INSIDE) or any(name.startswith("_") for name in (*module.split("."), *names)):
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}: from {module} import {', '.join(names)}")
            if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
                owner = ast.unparse(node.value)
                if owner not in ("self", "cls", "super()") and node.attr not in OWN:
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno}: {owner}.{node.attr}")
    assert found == [], "belongs into lerobot_playbyear/compat.py"
