"""Writes the names of all options of our commands, by which they refuse what is misspelt before LeRobot is imported; and
docs/reference/options.md.

    python tools/list_options.py

Needed when an option of ours, its text, or LeRobot's version changes; a test says when.
"""

import dataclasses
import json
import typing
from importlib import metadata
from typing import Any

from draccus.argparsing import ArgumentParser
from draccus.utils import is_choice_type

from lerobot_playbyear.audio.attach_audio import AttachAudioConfig
from lerobot_playbyear.audio.attach_spectrogram import AttachSpectrogramConfig
from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.film.rollout_film import VideoConfig
from lerobot_playbyear.hub.push import PushConfig
from lerobot_playbyear.inspection.inspect import InspectConfig
from lerobot_playbyear.microphones.finding import FindMicrophonesConfig
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.recording.record import RecordConfig
from lerobot_playbyear.repair.repair import RepairConfig
from lerobot_playbyear.reproduce.config import ReproduceConfig
from lerobot_playbyear.scripts.command import OPTIONS_FILE
from lerobot_playbyear.training.config import PlaybyearTrainConfig

CONFIGS: dict[str, type] = {
    "playbyear-attach-audio": AttachAudioConfig,
    "playbyear-attach-spectrogram": AttachSpectrogramConfig,
    "playbyear-dagger": DaggerConfig,
    "playbyear-find-microphones": FindMicrophonesConfig,
    "playbyear-inspect": InspectConfig,
    "playbyear-push": PushConfig,
    "playbyear-record": RecordConfig,
    "playbyear-repair": RepairConfig,
    "playbyear-reproduce": ReproduceConfig,
    "playbyear-train": PlaybyearTrainConfig,
    "playbyear-video": VideoConfig,
}


def list_options() -> dict[str, Any]:
    """What the file holds: per command its options, and LeRobot's version, which has a say in them."""
    listed: dict[str, Any] = {name: _options_of(config) for name, config in CONFIGS.items()}
    return {
        "lerobot": metadata.version("lerobot"),
        "policies": {"playbyear": _options_of(PlaybyearConfig)["options"]},
        **listed,
    }


def _options_of(config: type) -> dict[str, Any]:
    hints = typing.get_type_hints(config)
    names = {field.name for field in dataclasses.fields(config)}
    opened = {name for name in names if any(map(_is_choice, (hints[name], *typing.get_args(hints[name]))))}
    groups = {"config_path", *names} - opened  # what the latter hold depends on a type
    options = {
        option.removeprefix("--")
        for action in ArgumentParser(config).parser._actions
        for option in action.option_strings
        if option.removeprefix("--").partition(".")[0] in groups
    }
    return {"options": sorted(options), "open": sorted(opened), "required": _required(config)}


def _required(config: type, prefix: str = "") -> list[str]:
    hints, required = typing.get_type_hints(config), []
    for field in dataclasses.fields(config):
        if field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING:
            continue
        name, kind = prefix + field.name, hints[field.name]
        nested = _required(kind, f"{name}.") if dataclasses.is_dataclass(kind) and isinstance(kind, type) else []
        required += [f"{name}.type"] if _is_choice(kind) else nested or [name]
    return required


def _is_choice(kind: Any) -> bool:
    return isinstance(kind, type) and is_choice_type(kind)


def as_text(listed: dict[str, Any]) -> str:
    """The file's content, a command per line."""
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in listed.items()) + "\n}\n"


if __name__ == "__main__":
    from options_page import PAGE, as_page

    OPTIONS_FILE.write_text(as_text(list_options()))
    PAGE.write_text(as_page(CONFIGS, list_options()))
