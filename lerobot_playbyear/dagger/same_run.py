"""Whether the options of a run that goes on are those that it began with."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from lerobot_playbyear.dagger.config import CONFIG_NAME, DaggerConfig

_SAME_RUN = (
    "demos",
    "interventions",
    "env",
    "expert",
    "method",
    "takeover_delay_s",
    "skip_s",
    "learn_from",
    "new_weights",
    "seed",
    "episode_seed",
    "warmup_episodes",
    "rename_map",
)  # options that stay as they are when a run goes on


def differences(folder: Path, cfg: DaggerConfig) -> list[str]:
    """What tells a run apart from the one in an output folder: another task, other data, another expert or method."""
    saved = json.loads((folder / CONFIG_NAME).read_text())
    plain = DaggerConfig(cfg.demos, cfg.interventions)
    options, defaults = (json.loads(json.dumps(each.options())) for each in (cfg, plain))
    saved.setdefault("skip_s", 0.0)
    for name in _SAME_RUN:
        saved.setdefault(name, defaults[name])  # an older version did not know it
        _fill_in(saved.get(name), options.get(name), getattr(cfg, name))
    changed = [
        f"--{name} was {_brief(saved.get(name))} and is {_brief(options.get(name))}"
        for name in _SAME_RUN
        if saved.get(name) != options.get(name)
    ]
    if (
        saved.get("episodes", cfg.episodes) > 0
    ) != cfg.is_online:  # one collects, and the other learns from what is there
        changed.append(f"--episodes was {saved['episodes']} and is {cfg.episodes}")
    return changed


def _fill_in(saved: Any, options: Any, config: Any) -> None:
    """What an older version did not know, and is as it is by default, was so then."""
    if not (isinstance(saved, dict) and isinstance(options, dict) and dataclasses.is_dataclass(config)):
        return
    if saved.get("type") != options.get("type"):  # they share no options
        return
    for option in dataclasses.fields(config):
        make: Any = option.default_factory
        default = option.default if make is dataclasses.MISSING else make()
        if option.name in options and option.name not in saved and getattr(config, option.name) == default:
            saved[option.name] = options[option.name]


def _brief(value: Any) -> str:
    if not isinstance(value, dict):
        return str(value)
    return str({key: item for key, item in value.items() if key not in ("features", "features_map", "video_backend")})
