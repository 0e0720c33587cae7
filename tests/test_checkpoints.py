"""Checkpoints that a training, a disk or somebody else spoilt are one error, and no policy that acts at random."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file, save_file
from support.shared import ENV, run_in_process

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.scripts.commands import dagger, train, video

pytestmark = pytest.mark.usefixtures("one_thread")

WEIGHTS, CONFIG = "model.safetensors", "config.json"
STATE = "policy_preprocessor_step_*_normalizer_processor.safetensors"


def weights(change: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        held = load_file(folder / WEIGHTS)
        change(held)
        save_file(held, folder / WEIGHTS, metadata={"format": "pt"})

    return spoil


def first(held: dict[str, torch.Tensor]) -> torch.Tensor:
    return next(value for name, value in sorted(held.items()) if value.is_floating_point() and value.dim() > 1)


def config(**changes: object) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        saved = json.loads((folder / CONFIG).read_text())
        (folder / CONFIG).write_text(json.dumps(saved | changes))

    return spoil


def file(pattern: str, change: Callable[[Path], object]) -> Callable[[Path], None]:
    return lambda folder: [change(path) for path in folder.glob(pattern)] and None


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def another_state(folder: Path) -> None:
    path = folder / "policy_preprocessor.json"
    saved = json.loads(path.read_text())
    for step in saved["steps"]:
        if "state_file" in step:
            step["state_file"] = "../" + step["state_file"]
    path.write_text(json.dumps(saved))


OF_POLICY: dict[str, tuple[Callable[[Path], object], str]] = {
    "weights: NaN": (weights(lambda held: first(held).fill_(float("nan"))), "NaN"),
    "weights: infinite": (weights(lambda held: first(held)[0].fill_(float("inf"))), "infinite"),
    "weights: missing": (weights(lambda held: held.pop(next(iter(held)))), "it lacks ['"),
    "weights: of another size": (config(hidden_size=48), "does not fit the policy"),
    "weights: cut": (file(WEIGHTS, cut), "model.safetensors is missing or damaged"),
    "weights: no file": (file(WEIGHTS, Path.unlink), "model.safetensors is missing or damaged"),
    "size: 10**6": (
        config(hidden_size=10**6),
        "--policy.hidden_size must be at least 1 and at most 8,192, got 1000000",
    ),
    "size: 0": (config(embedding_size=0), "--policy.embedding_size must be at least 1 and at most 8,192, got 0"),
    "size: pictures": (
        config(image_size=10**5),
        "--policy.image_size must be at least 1 and at most 4,096, got 100000",
    ),
}
OF_PROCESSORS: dict[str, tuple[Callable[[Path], object], str]] = {
    "statistics: missing": (file(STATE, Path.unlink), "cannot be read"),
    "statistics: cut": (file(STATE, cut), "cannot be read"),
    "statistics: elsewhere": (another_state, "it is not the name of a file beside it"),
}


QUICK = ("weights: NaN", "weights: missing", "size: 10**6", "statistics: missing", "statistics: elsewhere")
ALL = [*OF_POLICY, *OF_PROCESSORS]


@pytest.mark.parametrize(
    "what", [*QUICK, *(pytest.param(each, marks=pytest.mark.slow) for each in ALL if each not in QUICK)]
)
def test_a_spoilt_checkpoint_is_one_error_of_every_command(recorded, trained, tmp_path, what):
    spoil, said = {**OF_POLICY, **OF_PROCESSORS}[what]
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    spoil(checkpoint)
    policy, out = f"--policy.path={checkpoint}", f"--output_dir={tmp_path / 'out'}"
    demos = ("repo_id=tests/demos", f"root={recorded}")
    data = [f"--dataset.{each}" for each in demos]
    more = [*data, "--interventions.repo_id=t/more", f"--interventions.root={tmp_path / 'more'}", "--eval_every=0"]
    told = [
        run_in_process(train, policy, out, *data, "--policy.push_to_hub=false", "--steps=1", "--num_workers=0"),
        run_in_process(dagger, policy, out, *ENV, *more),
        run_in_process(video, *ENV, policy, f"--output={tmp_path / 'film.mp4'}"),
    ]
    for one in told:
        assert str(one).startswith("error: ")
        assert said in one


@pytest.mark.parametrize("what", OF_POLICY)
def test_whoever_loads_a_spoilt_checkpoint_is_told_too(trained, tmp_path, what):
    """As lerobot-eval and lerobot-rollout do."""
    spoil, said = OF_POLICY[what]
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    spoil(checkpoint)
    with pytest.raises((ValueError, ParsingError)) as refused:
        PlaybyearPolicy.from_pretrained(checkpoint, config=PreTrainedConfig.from_pretrained(checkpoint))
    assert said in f"{refused.value} {refused.value.__cause__}"


def test_weights_that_are_too_many_are_named(trained, tmp_path, caplog):
    checkpoint = Path(shutil.copytree(trained, tmp_path / "policy"))
    weights(lambda held: held.update({"model.hand.weight": torch.ones(2)}))(checkpoint)
    with caplog.at_level(logging.WARNING):
        PlaybyearPolicy.from_pretrained(checkpoint)
    assert "has ['model.hand.weight'] too many" in caplog.text
    with pytest.raises(ValueError, match=r"has \['model.hand.weight'\] too many"):
        PlaybyearPolicy.from_pretrained(checkpoint, strict=True)
