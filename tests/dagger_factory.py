"""An expert of a few steps and the command line of `playbyear-dagger`, for tests of HG-DAgger."""

import json
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import parser
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from safetensors.torch import load_file
from support.failing import PowerCut, fail_once
from support.shared import ENV, once, recorded, trained

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger.config import with_saved_options
from lerobot_playbyear.dagger.run import run_dagger
from lerobot_playbyear.dagger.run_folder import RunFolder
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.experts import Expert, ExpertConfig
from lerobot_playbyear.episodes.play import Verdict
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.teleoperation import config as _teleop  # noqa: F401  (registers --expert.type=teleop)

QUICK = ("--expert.type=test_quick", "--env.episode_length=12")
"""Attempts of a few steps, of which every third is not worth keeping."""

SMALL = ("--updates_per_episode=2", "--warmup_episodes=1", "--batch_size=4", "--eval_every=0")
FINISHED = ("--num_episodes=3", "--warmup_episodes=2", "--eval_every=2", "--eval.n_episodes=1", "--eval.batch_size=1")
"""A run of three kept attempts with an evaluation before, after the second round, and at the end."""


@ExpertConfig.register_subclass("test_quick")
@dataclass
class QuickConfig(ExpertConfig):
    """Acts for three steps and ends the attempt: as a success, but for seeds that 3 divides."""

    n_steps: int = 8

    def make(self, env):
        return Quick(self.n_steps)


class Quick(Expert):
    def __init__(self, n_steps):
        self.n_steps = n_steps

    def reset(self, env):
        self.n, self.seed = 0, env.unwrapped.np_random_seed
        self.is_success = self.seed % 3 > 0

    def wants_control(self, observation, policy_action):
        self.n += 1
        return 3 <= self.n < 6

    def act(self):
        return np.array([0.2, 0.1, -0.2, -1.0], np.float32)

    def verdict(self):
        if self.n < self.n_steps:
            return None
        return Verdict.SUCCESS if self.is_success else Verdict.FAILURE


def finished() -> Path:
    """The folder of a run that ended: `out` and `corrections`. Copy it to change it."""
    return once("finished", lambda folder: dagger(folder, *QUICK, *FINISHED))


def arguments(folder: Path, *options: str, env: tuple[str, ...] = ENV) -> list[str]:
    """The command line of a small run in `folder`; later options win."""
    given = [
        f"--policy.path={trained()}",
        "--dataset.repo_id=tests/demos",
        f"--dataset.root={recorded()}",
        "--interventions.repo_id=tests/corrections",
        f"--interventions.root={folder / 'corrections'}",
        f"--output_dir={folder / 'out'}",
        *env,
        *SMALL,
        *options,
    ]
    return list({option.split("=")[0]: option for option in given}.values())


def dagger(folder: Path, *options: str, **kwargs: Any) -> Path:
    """Run the command in this process. Returns the output folder."""
    return command(*arguments(folder, *options, **kwargs))


def command(*args: str) -> Path:
    """Run the command with these arguments in this process, as `main` does, but without turning errors into exits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["playbyear-dagger", *with_saved_options(list(args))])
        return parser.wrap()(run_dagger)()


def metrics(folder: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """The lines of figures of a run, of one kind or all."""
    lines = [json.loads(line) for line in (folder / "out" / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if kind in (None, line["kind"])]


def state(folder: Path) -> dict[str, Any]:
    """The counters of a run."""
    return json.loads((folder / "out" / "dagger_state.json").read_text())


def corrections(folder: Path) -> LeRobotDataset:
    """The intervention dataset, opened with LeRobot alone."""
    return LeRobotDataset("tests/corrections", root=folder / "corrections", video_backend="pyav")


def column(dataset: LeRobotDataset, key: str) -> np.ndarray:
    """All values of a column, (N, ...)."""
    return np.stack([np.asarray(value) for value in dataset.hf_dataset.with_format("numpy")[key]])


def seeds(folder: Path) -> list[int]:
    """The seed of each attempt in the intervention dataset, in their order."""
    dataset = corrections(folder)
    values = column(dataset, "seed").ravel()
    return [int(values[row["dataset_from_index"]]) for row in dataset.meta.episodes]


# Attempts without a run


class Scripted(Expert):
    """Takes over in chosen steps, asks the task's expert what to do, and remembers it."""

    def __init__(self, steps=(), verdicts=None):
        self.steps, self.verdicts = steps, verdicts or {}

    def reset(self, env):
        self.n, self.actions = -1, {}
        self.script = env.unwrapped.scripted_expert()

    def wants_control(self, observation, policy_action):
        self.n += 1
        self.wanted = self.script.act()
        return self.n in self.steps

    def act(self):
        self.actions[self.n] = self.wanted
        return self.wanted

    def verdict(self):
        return self.verdicts.get(self.n)


@cache
def scene(n_steps=20):
    """An environment and the policy in it. Made once: leave it open."""
    env_cfg = PlaybyearEnvConfig(image_size=16, episode_length=n_steps)
    policy = PlaybyearPolicy.from_pretrained(trained())
    processors = make_pre_post_processors(policy.config, str(trained()))
    return env_spec(env_cfg).make(), PolicyActor(policy, env_cfg, *processors)


# Runs that are stopped


def weights(folder):
    return load_file(folder / "out/checkpoints/last/pretrained_model/model.safetensors")


def figures(folder):
    """All figures but times, and where they stand; a recovered attempt has no times anyway."""
    lines = [{key: value for key, value in line.items() if not key.endswith("_s")} for line in metrics(folder)]
    return [{key: value for key, value in line.items() if key != "recovered"} for line in lines]


def assert_ended_alike(folder, expected):
    assert seeds(folder) == seeds(expected)
    for key in ("action", "intervention", "observation.state", "observation.audio.gripper"):
        np.testing.assert_array_equal(column(corrections(folder), key), column(corrections(expected), key))
    ours, theirs = weights(folder), weights(expected)
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert figures(folder) == figures(expected)
    assert state(folder) == state(expected)
    assert {path.name for path in (folder / "out").iterdir()} == {path.name for path in (expected / "out").iterdir()}
    names = [{path.name for path in (f / "out/checkpoints").iterdir()} for f in (folder, expected)]
    assert names[0] == names[1]


def assert_a_power_cut_changes_nothing(folder, expected, run, after, owner=RunFolder, name="commit"):
    """A run that is stopped there, and goes on, ends as one that was not."""
    with pytest.MonkeyPatch.context() as patch:
        fail_once(patch, owner, name, after)
        with pytest.raises(PowerCut):
            dagger(folder, *run)
    command("--resume=true", f"--output_dir={folder / 'out'}")
    assert_ended_alike(folder, expected)
