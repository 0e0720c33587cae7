"""The lottery's variants are options that exist, and one training is evaluated as every policy that it holds."""

import json
from dataclasses import asdict
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from experiments import lottery, training
from experiments.lottery import CHOICE_SEEDS, EMA, HELD_OUT, LAST_THREE, NEWEST, PLAIN, POLICIES, VARIANTS, job_of
from experiments.protocol import EVALUATION_SEEDS, Result
from experiments.training import Evaluation
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.scripts.command import OPTIONS_FILE
from lerobot_playbyear.training.presets import RECIPES

pytestmark = pytest.mark.usefixtures("one_thread")

OTHERS = {policy for policies in POLICIES.values() for policy in policies}


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
    assert changed or variant in ("preset", "half_the_runs", "twice_the_runs", HELD_OUT)


def test_no_choice_is_made_on_the_seeds_that_are_reported():
    assert not set(CHOICE_SEEDS) & set(EVALUATION_SEEDS)
    assert not OTHERS & VARIANTS.keys()


@pytest.fixture
def evaluated(tmp_path, monkeypatch):
    """Evaluations that only note what they were asked for."""
    for module in (lottery, training):
        monkeypatch.setattr(module, "RUNS", tmp_path / "runs")
        monkeypatch.setattr(module, "RESULTS", tmp_path / "results")
    asked = []

    def evaluate(job, commands, *options, name, checkpoint):
        asked.append((checkpoint.relative_to(tmp_path / "runs" / "train"), options, name))
        commands.append("lerobot-eval ...")
        return Evaluation([True, False], [False, True])

    monkeypatch.setattr(lottery, "evaluate", evaluate)
    return asked


@pytest.mark.parametrize("variant", [EMA, HELD_OUT])
def test_a_training_is_evaluated_as_every_policy_that_it_holds(variant, evaluated, tmp_path):
    job = job_of("OccludedGrasp-v1", variant, 3)
    checkpoints = tmp_path / "runs" / "train" / job.name / "checkpoints"
    for step in (500, 1000, 1500, 2000):
        folder = checkpoints / f"{step:06}" / "pretrained_model"
        folder.mkdir(parents=True)
        save_file({"weight": torch.full((2,), float(step))}, folder / "model.safetensors")
    for link in ("best", "last"):
        (checkpoints / link).symlink_to({"best": "001000", "last": "002000"}[link])
    trained = Result(
        **job.learned, first_seed=50000, successes=[True], minutes=7.0, threads=1, commands=["train", "eval"]
    )
    for policy in POLICIES[variant] * 2:  # the second time it is there
        result = lottery.evaluated_as(policy, job, trained)
        assert (result.successes, result.acted_early) == ([True, False], [False, True])
        assert asdict(result) == asdict(trained) | {
            "successes": [True, False], "acted_early": [False, True], "commands": result.commands}  # fmt: skip
    run = job.name
    assert {str(path): options for path, options, _ in evaluated} == {
        EMA: {
            f"{run}/checkpoints/last/pretrained_model": ("--policy.ema_decay=0",),
            f"{run}-last3": ("--policy.ema_decay=0",),
        },
        HELD_OUT: {f"{run}/checkpoints/last/pretrained_model": ()},
    }[variant]
    assert len(evaluated) == len(POLICIES[variant])
    if variant == EMA:
        mean = load_file(tmp_path / "runs" / "train" / f"{run}-last3" / "model.safetensors")["weight"]
        assert mean.tolist() == [1500.0, 1500.0]
        assert {PLAIN, LAST_THREE} == set(POLICIES[EMA])
    else:
        assert job.checkpoint.parts[-2] == "best"
        assert POLICIES[HELD_OUT] == (NEWEST,)
