"""What is borrowed from the inside of LeRobot and torch is there, and borrowed in one place: a new version fails here first."""

import ast
import importlib
import inspect
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest
import torch

from lerobot_playbyear import compat
from lerobot_playbyear.compat import BORROWED, CompatError

ROOT = Path(__file__).parent.parent
PACKAGES = (ROOT / "lerobot_playbyear", ROOT / "envs")
OURS = [path for folder in PACKAGES for path in sorted(folder.rglob("*.py")) if path.name != "compat.py"]
INSIDE = ("lerobot.scripts", "lerobot.common")
OWN = {
    "_asked_dtype",  # of our own configuration
    "_max_episode_steps",  # of our own environments, where LeRobot asks for it
    "_exit",  # of the standard library, documented
}
_PAD = "a gamepad that is not plugged in is not noticed"
SAID = [
    (
        "policies.factory:make_policy",
        'kwargs["dataset_meta"] = ds_meta',
        "lerobot-train takes a dataset of another frame rate without a word",
    ),
    # Attributes of LeRobot's objects
    ("teleoperators.gamepad:GamepadTeleop", "self.gamepad = ", _PAD),
    ("teleoperators.gamepad.gamepad_utils:GamepadController", "self.running = False", _PAD),
]
"""Where in LeRobot, what its source says there, and what does not work without; of this no other test would fail."""


@pytest.mark.parametrize("name", BORROWED)
def test_what_is_borrowed_is_there(name):
    if "mkldnn" in BORROWED[name][0] and not torch.backends.mkldnn.is_available():
        pytest.skip("this build of torch has no oneDNN, and the policy does without")
    compat.load(*BORROWED[name])


@pytest.mark.parametrize(("where", "says", "breaks"), SAID)
def test_lerobot_does_with_ours_what_we_hold_on_to(where, says, breaks):
    assert says in inspect.getsource(resolve_name(f"lerobot.{where}")), f"{where} changed. Without it: {breaks}"


def test_torch_counts_changes():
    assert hasattr(torch.Tensor, "_version"), "a policy goes on acting by weights from before an update"


@pytest.mark.parametrize("gone", ["lerobot.policies.elsewhere:make", "lerobot.policies:make_nothing"])
def test_what_is_gone_is_missed_with_a_sentence(gone):
    with pytest.raises(CompatError, match=rf"In lerobot [\d.]+ there is no {gone} .*\. Without it: nothing works"):
        compat.load(gone, "nothing works")


def test_a_package_that_cannot_be_imported_does_not_keep_the_others_out(tmp_path, monkeypatch):
    for name, text in {"broken": "raise RuntimeError('its licence has ended')", "whole": "is_there = True"}.items():
        (tmp_path / "makers" / name).mkdir(parents=True)
        (tmp_path / "makers" / name / "__init__.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    compat.import_devices(importlib.import_module("makers"))
    assert sys.modules["makers.whole"].is_there
    assert "makers.broken" not in sys.modules


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
