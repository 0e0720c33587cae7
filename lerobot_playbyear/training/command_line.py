"""Command lines before LeRobot's parser sees them, for it takes ten seconds to import; and presets of `playbyear-train`.

`--preset=cpu` stands for the options in `recipes/cpu.json`. Options on the command line win over the preset, and the preset
wins over a configuration file. On CPUs that compute in bfloat16 the preset `cpu` switches `policy.use_amp` on. The files are
configuration files as well: `--config_path` takes them, and copies of them.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot_playbyear.datasets.errors import InputError

RECIPES = Path(__file__).with_name("recipes")
"""Folder of the presets' files."""

PRESETS = {
    "cpu": "one or two CPU cores, 6 to 17 minutes",
    "gpu": "the paper's number of windows at 224 pixels, for a GPU; 5 minutes on an H200",
    "paper": "the published experiment: 1.6 million windows at 224 pixels, for a GPU",
}
"""When to choose which. What each is, and what differs from the publication on purpose: docs/how_to/train.md."""

_NETWORK = (
    *("type", "device", "image_size", "vision_width", "normalize_encodings", "low_dimensional_gain", "hop_s"),
    *("n_memory_steps", "action_range", "audio_envelope_gain", "memory_displacement_gain", "memory_readers"),
    *("auxiliary_onset", "auxiliary_balance", "auxiliary_way"),
)
"""Options of the policy that fix what the network is and what its numbers mean: with `--policy.path` the checkpoint says it."""


def given_options(args: Sequence[str]) -> tuple[dict[str, str | None], list[str]]:
    """What a command line gives, as `--name=value` or `--name value`.

    Args:
        args: Without the command's own name.

    Returns:
        The value of every option, the first one where it is given twice, None where it has none; and what is not an option.
    """
    options: dict[str, str | None] = {}
    strays: list[str] = []
    rest = list(args)
    while rest:
        name, has_value, value = rest.pop(0).partition("=")
        if not name.startswith("--"):
            strays.append(name + has_value + value)
        elif has_value or not rest or rest[0].startswith("--"):
            options.setdefault(name[2:], value if has_value else None)
        else:
            options.setdefault(name[2:], rest.pop(0))
    return options, strays


def with_long_store(args: Sequence[str]) -> list[str]:
    """`--store=disk`, or `--store disk`, as the parser knows it: `--store.place=disk`."""
    rest, long = list(args), []
    while rest:
        name, has_value, value = rest.pop(0).partition("=")
        if name == "--store" and not has_value and rest and not rest[0].startswith("--"):
            value = rest.pop(0)
        is_short = name == "--store" and value and not value.endswith((".json", ".yaml"))
        long.append(f"--store.place={value}" if is_short else name + has_value + value)
    return long


def preset_options(name: str) -> dict[str, str]:
    """The options of a preset, as a command line gives them."""
    options: dict[str, str] = {}
    for key, value in json.loads((RECIPES / f"{name}.json").read_text()).items():
        values: dict[str, Any] = {f"policy.{k}": v for k, v in value.items()} if key == "policy" else {key: value}
        options |= {k: v if isinstance(v, str) else json.dumps(v) for k, v in values.items()}
    return options


def apply_preset(args: Sequence[str]) -> list[str]:
    """Put a preset's options before those of a command line, as far as that does not give them itself.

    Args:
        args: Command-line arguments; without `--preset` they are returned as they are. When a run is resumed, its
            checkpoint holds all options and the preset changes nothing.

    Raises:
        InputError: If there is no such preset, or the policy is of another type.
    """
    given, _ = given_options(args)
    name = given.get("preset")
    if name is None or (given.get("resume") or "").lower() in ("true", "1", "yes"):
        return list(args)
    if name not in PRESETS:
        known = "; ".join(f"{key} ({purpose})" for key, purpose in PRESETS.items())
        raise InputError(f"--preset={name} is not known. The presets are: {known}.")
    options, policy_type = preset_options(name), given.get("policy.type")
    if policy_type not in (None, options["policy.type"]):
        raise InputError(
            f"--preset={name} is for --policy.type={options['policy.type']}, not for {policy_type}: leave one of the two out."
        )
    if given.get("policy.path") is not None:
        options = {key: value for key, value in options.items() if key.removeprefix("policy.") not in _NETWORK}
    if name == "cpu":
        from lerobot_playbyear.policy.optimization import computes_bfloat16  # imports torch

        options |= {"policy.use_amp": "true"} if computes_bfloat16() else {}
    if "steps" in given:
        options.pop("steps_per_episode", None)
    if "policy.repo_id" in given:  # whoever names a place on the Hub wants it used
        options = {key: value for key, value in options.items() if key != "policy.push_to_hub"}
    return [*(f"--{key}={value}" for key, value in options.items() if key not in given), *args]
