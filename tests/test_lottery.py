"""The lottery's variants are options that exist."""

import json
from typing import Any

import pytest
import yaml

from experiments.lottery import CHOICE_SEEDS, VARIANTS
from experiments.protocol import EVALUATION_SEEDS
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.scripts.command import OPTIONS_FILE
from lerobot_playbyear.training.presets import RECIPES

pytestmark = pytest.mark.usefixtures("one_thread")


def policy_of(options: tuple[str, ...]) -> dict[str, Any]:
    """The policy's options in the preset `cpu` with these; those of the training have to exist."""
    listed = json.loads(OPTIONS_FILE.read_text())
    policy = json.loads((RECIPES / "cpu.json").read_text())["policy"]
    del policy["type"]
    for option in options:
        name, _, value = option.removeprefix("--").partition("=")
        if name.startswith("policy."):
            policy[name.removeprefix("policy.")] = yaml.safe_load(value)
        else:
            assert name in listed["playbyear-train"]["options"], option
    return vars(PlaybyearConfig(**policy))  # refuses what it does not know


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_is_one_change_of_options_that_exist(variant):
    plain, other = policy_of(()), policy_of(VARIANTS[variant])
    changed = {name for name, value in other.items() if plain[name] != value}
    given = {option.partition("=")[0].removeprefix("--policy.") for option in VARIANTS[variant]}
    assert changed <= given
    assert changed or variant in ("preset", "half_the_runs", "twice_the_runs")


def test_no_choice_is_made_on_the_seeds_that_are_reported():
    assert not set(CHOICE_SEEDS) & set(EVALUATION_SEEDS)
