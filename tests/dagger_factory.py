"""A small policy, its demonstrations and the command line of `playbyear-dagger`, for tests of HG-DAgger."""

import json
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from lerobot.configs import parser
from lerobot.datasets import LeRobotDataset

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import Expert, ExpertConfig, Verdict, run_dagger
from lerobot_playbyear.dagger.config import with_saved_options
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.teleoperation import config as _teleop  # noqa: F401  (registers --expert.type=teleop)
from lerobot_playbyear.training.train import train

ENV = ("--env.type=playbyear", "--env.task=OccludedGrasp-v1", "--env.image_size=16")
QUICK = ("--expert.type=test_quick", "--env.episode_length=12")
"""Attempts of a few steps, of which every third is not worth keeping."""

SMALL = ("--updates_per_episode=2", "--warmup_episodes=1", "--batch_size=4", "--eval_every=0")
_TINY_POLICY = (
    "--policy.type=playbyear",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.image_size=16",
    "--policy.vision_width=4",
    "--policy.audio_window_s=0.9",
    "--policy.n_memory_steps=2",
    "--policy.n_supervised_steps=4",
    "--policy.hidden_size=32",
)


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
        self.n, self.is_success = 0, env.unwrapped.np_random_seed % 3 > 0

    def wants_control(self, observation, policy_action):
        self.n += 1
        return 3 <= self.n < 6

    def act(self):
        return np.array([0.2, 0.1, -0.2, -1.0], np.float32)

    def verdict(self):
        if self.n < self.n_steps:
            return None
        return Verdict.SUCCESS if self.is_success else Verdict.FAILURE


@cache
def base_folder() -> Path:
    """A folder with `demos`, two episodes of the expert, and `policy`, a checkpoint after two updates: it does nothing well."""
    folder = Path(mkdtemp(prefix="dagger_"))
    demos = RecordDatasetConfig("tests/demos", str(folder / "demos"), num_episodes=2)
    record(RecordConfig(PlaybyearEnvConfig(image_size=16), demos, num_workers=0))
    data = ("--dataset.repo_id=tests/demos", f"--dataset.root={folder / 'demos'}", "--num_workers=0")
    run = ("--steps=2", "--batch_size=2", f"--output_dir={folder / 'train'}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train", *_TINY_POLICY, *data, *run])
        parser.wrap()(train)()
    (folder / "policy").symlink_to(folder / "train/checkpoints/last/pretrained_model")
    return folder


def arguments(folder: Path, *options: str, env: tuple[str, ...] = ENV) -> list[str]:
    """The command line of a small run in `folder`; later options win."""
    base = base_folder()
    given = [
        f"--policy.path={base / 'policy'}",
        "--demos.repo_id=tests/demos",
        f"--demos.root={base / 'demos'}",
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
