"""The page docs/reference/options.md: every option with its default and what its dataclass says of it."""

import dataclasses
import fnmatch
import inspect
import itertools
import json
import re
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from draccus.utils import is_choice_type

from lerobot_env_playbyear.config import PlaybyearEnvConfig
from lerobot_playbyear.dagger.methods import HgDagger, NoHandback, Redo
from lerobot_playbyear.dagger.robot_gated import RobotGated
from lerobot_playbyear.episodes.experts import ScriptedExpertConfig
from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

PAGE = Path(__file__).parents[1] / "docs/reference/options.md"

_GROUPS: dict[str, tuple[type, str]] = {
    "Policy": (PlaybyearConfig, "--policy.type=playbyear"),
    "Environment": (PlaybyearEnvConfig, "--env.type=playbyear"),
    "Scripted expert": (ScriptedExpertConfig, "--expert.type=scripted"),
    "Person as expert": (TeleopExpertConfig, "--expert.type=teleop"),
    "HG-DAgger": (HgDagger, "--method.type=hg_dagger"),
    "No hand-back": (NoHandback, "--method.type=no_handback"),
    "Redo": (Redo, "--method.type=redo"),
    "Robot-gated": (RobotGated, "--method.type=robot_gated"),
    "Microphone": (MicrophoneCameraConfig, "type: microphone"),
}
"""Headings, what stands under them, and what chooses it."""

_HEAD = """# Options

Every option of the commands, with its default. `playbyear-... --help` prints the most important ones, `--help=all` prints all.

- `null` stands for no value, `...` for a value without a default.
- `--policy.*`, `--env.*`, `--expert.*` and `--method.*` depend on a type. They stand below the commands.
- `--config_path=options.json` reads options from a file.
"""


def as_page(configs: Mapping[str, type], listed: Mapping[str, Any]) -> str:
    """The page's text.

    Args:
        configs: The commands and their configurations.
        listed: The names of each command's options, as `list_options` gives them.
    """
    parts = [_HEAD]
    for command, config in configs.items():
        rows = list(_rows(config, ""))
        parts += [f"## {command}\n", _table(rows), _others(rows, listed[command]["options"])]
    for heading, (config, chosen_by) in _GROUPS.items():
        prefix = re.match(r"--(\w+\.)|", chosen_by)
        rows = list(_rows(config, (prefix and prefix[1]) or ""))
        about, _, _ = re.sub(r"\n(?=\w+:\n)", "\n\n", inspect.getdoc(config) or "").partition("\n\n")
        parts += [f"## {heading}\n", f"`{chosen_by}`: {' '.join(about.split())}\n"]
        parts.append(_table(rows, "--" if prefix and prefix[1] else "") if rows else "It has no options.\n")
        if config is PlaybyearConfig:
            parts.append(
                _others(rows, [f"policy.{name}" for name in listed["policies"]["playbyear"] if name != "config_path"])
            )
    return "\n".join(part for part in parts if part)


def _others(rows: list[tuple[dict[str, str], str]], names: list[str]) -> str:
    """Those that our docstrings say nothing of, without the names of whole groups."""
    known = {name for options, _ in rows for name in options} | {"config_path"}
    others = [name for name in names if not any(each == name or each.startswith(f"{name}.") for each in known)]
    others = [name for name in others if not any(each.startswith(f"{name}.") for each in others)]
    return "LeRobot's own: " + ", ".join(f"`--{name}`" for name in others) + ".\n" if others else ""


def _rows(config: type, prefix: str) -> Iterator[tuple[dict[str, str], str]]:
    """Options that share a text, with their defaults, and the text."""
    texts, hints = _texts(config), typing.get_type_hints(config)
    for text, group in itertools.groupby(dataclasses.fields(config), lambda field: _text_of(field.name, texts)):
        if text is None:
            continue
        plain = {}
        for field in group:
            name, kind = prefix + field.name, hints[field.name]
            kinds = [kind, *typing.get_args(kind)]
            nested = next((each for each in kinds if dataclasses.is_dataclass(each)), None)
            if any(isinstance(each, type) and is_choice_type(each) for each in kinds):
                plain[f"{name}.type"] = "..."
            elif nested is not None:
                inner = list(_rows(nested, f"{name}."))
                yield {f"{name}.*": ""}, text
                yield from inner
            else:
                plain[name] = _default(field)
        if plain:
            yield plain, text


def _text_of(name: str, texts: Mapping[str, str]) -> str | None:
    return next(
        (text for names, text in texts.items() if any(fnmatch.fnmatch(name, n) for n in names.split(", "))), None
    )


def _texts(config: type) -> dict[str, str]:
    """What a dataclass's docstring, and those that it inherits from, say of its fields."""
    texts: dict[str, str] = {}
    for base in config.__mro__:
        if not base.__module__.startswith(("lerobot_playbyear.", "lerobot_env_playbyear.")):
            continue
        items = re.findall(
            r"^ {4}([\w*]+(?:, [\w*]+)*): ((?:.*\n)(?: {8}.*\n)*)", f"{inspect.getdoc(base)}\n", re.MULTILINE
        )
        texts = {name: " ".join(text.split()) for name, text in items} | texts
    return texts


def _default(field: dataclasses.Field[Any]) -> str:
    value = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
    if value is dataclasses.MISSING:
        return "..."
    if isinstance(value, str | Path):
        return str(value)
    return json.dumps(value, default=lambda each: each.name if isinstance(each, Enum) else str(each))


def _table(rows: list[tuple[dict[str, str], str]], dashes: str = "--") -> str:
    lines = ["| option | |", "|---|---|"]
    for options, text in rows:
        named = "<br>".join(f"`{dashes}{name}{'=' if default else ''}{default}`" for name, default in options.items())
        for python, json_ in (("None", "null"), ("True", "true"), ("False", "false")):
            text = re.sub(rf"\b{python}\b", json_, text)
        lines.append(f"| {named} | {text.replace('|', '&#124;')} |")
    return "\n".join(lines) + "\n"
