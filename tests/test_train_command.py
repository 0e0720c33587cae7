"""playbyear-train learns what lerobot-train learns, and either continues the other's checkpoints."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_factory import make_dataset
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from support import shared
from support.shared import run_in_process

from lerobot_playbyear.datasets.files import PARTIAL
from lerobot_playbyear.hub.push import read_metrics
from lerobot_playbyear.scripts.commands import train
from lerobot_playbyear.training.command_line import PRESETS, RECIPES, apply_preset, preset_options
from lerobot_playbyear.training.config import PlaybyearTrainConfig, StoreConfig
from lerobot_playbyear.training.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")

FPS = 20
TINY = (*shared.TINY, "--log_freq=2")


def data(root):
    return "--dataset.repo_id=tests/noise", f"--dataset.root={root}"


def config_of(checkpoint):
    return checkpoint / "pretrained_model" / "train_config.json"


def step_of(checkpoint):
    return json.loads((checkpoint / "training_state" / "training_step.json").read_text())["step"]


def weights_of(checkpoint):
    return load_file(checkpoint / "pretrained_model" / "model.safetensors")


@pytest.fixture(scope="module")
def trained(noise, tmp_path_factory):
    """The output folder of a run of six updates, three for each episode learned, with checkpoints every three."""
    output = tmp_path_factory.mktemp("run") / "out"
    options = ("--steps=1", "--steps_per_episode=3", "--save_freq=3", "--store.place=memory")
    validation = ("--dataset.eval_split=0.3", "--eval_steps=3")
    run_in_process(train, *TINY, *data(noise), *options, *validation, f"--output_dir={output}")
    return output


def test_a_run_leaves_lerobots_checkpoints_and_its_figures(trained):
    checkpoints = trained / "checkpoints"
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]

    assert sorted(path.name for path in checkpoints.iterdir()) == ["000003", "000006", "last"]
    assert (checkpoints / "last").resolve().name == "000006"
    kinds = [(line["kind"], line["step"]) for line in lines]
    assert kinds == [("train", 2), ("validation", 3), ("train", 4), ("train", 6), ("validation", 6)]
    assert all(torch.isfinite(torch.tensor(line["loss"])) for line in lines)
    ours = PlaybyearTrainConfig.from_pretrained(config_of(checkpoints / "last"), cli_args=["--store.device=cpu"])
    assert ours.store == StoreConfig(place="memory", device="cpu")
    assert (ours.steps, ours.steps_per_episode) == (6, 0)


def test_measuring_held_out_episodes_changes_nothing_that_is_learned(trained, noise, tmp_path):
    held_out = ("--dataset.eval_split=0.3", "--eval_steps=0")
    run_in_process(train, *TINY, *data(noise), "--steps=6", *held_out, f"--output_dir={tmp_path / 'out'}")
    ours, theirs = (weights_of(folder / "checkpoints" / "last") for folder in (tmp_path / "out", trained))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


@pytest.mark.slow
def test_a_policy_is_tuned_with_sound_of_another_rate(trained, tmp_path):
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    sample_rate = json.loads((policy / "config.json").read_text())["sample_rate"]
    make_dataset(tmp_path / "faster", (12, 9), image_size=16, sample_rate=3 * sample_rate)
    options = ("--policy.push_to_hub=false", "--num_workers=0", "--steps=1", "--batch_size=2")
    output = tmp_path / "out"
    run_in_process(train, f"--policy.path={policy}", *data(tmp_path / "faster"), *options, f"--output_dir={output}")
    tuned = json.loads((output / "checkpoints/last/pretrained_model/config.json").read_text())
    assert tuned["sample_rate"] == sample_rate


def test_lerobot_train_and_playbyear_train_continue_each_other(trained, tmp_path):
    ours = trained / "checkpoints" / "last"

    options = ("--resume=true", f"--config_path={config_of(ours)}", "--steps=7", f"--output_dir={tmp_path}")
    run_in_process(lerobot_train.train, *options)
    theirs = tmp_path / "checkpoints" / "last"
    assert step_of(theirs.resolve()) == 7
    run_in_process(train, "--resume=true", f"--config_path={config_of(theirs)}", "--steps=8")

    assert step_of(theirs.resolve()) == 8


def test_a_checkpoint_is_written_as_a_whole_in_a_copied_run_too(trained, tmp_path, monkeypatch):
    run = tmp_path / "run"
    shutil.copytree(trained, run)  # `last` is a folder in it
    (run / "metrics.jsonl").write_text('{"kind": "training", "st')  # as after a power cut
    checkpoints = run / "checkpoints"
    (checkpoints / f"last{PARTIAL}").symlink_to("000006")  # as after a kill
    options = ("--resume=true", f"--config_path={config_of(checkpoints / '000003')}", "--save_freq=6")
    weights = checkpoints / "000006/pretrained_model/model.safetensors"
    before = weights.read_bytes()

    def fail(_: object, folder: Path | None = None, cfg: object = None) -> None:
        if folder is not None:
            (folder / "half").touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    for owner, call in ((Learner, "write_checkpoint"), (os, "fsync")):
        monkeypatch.setattr(owner, call, fail)
        with pytest.raises(OSError, match="No space left"):
            run_in_process(train, *options, "--steps=6", f"--output_dir={run}")
        assert weights.read_bytes() == before
        monkeypatch.undo()
    run_in_process(train, *options, "--steps=6", f"--output_dir={run}")
    assert (checkpoints / "last").readlink() == Path("000006")
    assert step_of(checkpoints / "last") == 6
    assert {path.name for path in checkpoints.iterdir()} == {"000003", "000006", "last"}
    assert {"training", "validation"} & {line["kind"] for line in read_metrics(run)}


def test_a_checkpoint_is_fine_tuned_with_a_preset_that_leaves_its_network_alone(trained, noise, tmp_path):
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    options = ("--preset=cpu", "--steps=1", "--batch_size=2", "--policy.use_amp=false")

    run_in_process(train, f"--policy.path={policy}", *data(noise), *options, f"--output_dir={tmp_path / 'out'}")

    tuned = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    assert (tuned["image_size"], tuned["vision_width"]) == (16, 4)
    assert (tuned["n_memory_steps"], tuned["action_range"]) == (2, 1.0)
    assert tuned["n_supervised_steps"] == int(preset_options("cpu")["policy.n_supervised_steps"])


def test_the_policy_is_rolled_out_while_it_trains(trained, tmp_path, capfd):
    pytest.importorskip("lerobot_env_playbyear")
    rollouts = ("--env.type=playbyear", "--env.episode_length=4", "--env_eval_freq=100", "--eval.n_episodes=1")
    checkpoint = f"--config_path={config_of(trained / 'checkpoints' / 'last')}"

    run_in_process(train, "--resume=true", checkpoint, "--steps=7", *rollouts, f"--output_dir={tmp_path}")

    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    assert (last["kind"], last["step"], last["pc_success"]) == ("eval", 7, 0)
    assert last["pc_acted_early"] in (0, 100)
    assert f"Early:      {last['pc_acted_early']:.1f} % of them acted" in capfd.readouterr().out
    assert list((tmp_path / "eval").rglob("*.mp4"))


def test_a_preset_gives_way_to_the_command_line_and_leaves_checkpoints_and_the_hub_alone():
    given = apply_preset(["--preset=cpu", "--steps=10", "--policy.image_size", "64"])
    assert "--policy.vision_width=16" in given
    told = [arg for arg in given if arg.startswith(("--steps", "--policy.image_size"))]
    assert told == ["--steps=10", "--policy.image_size"]
    assert "--steps_per_episode=25" in apply_preset(["--preset=cpu"])
    tuned = apply_preset(["--preset=cpu", "--policy.path=somewhere"])
    resumed = apply_preset(["--preset=cpu", "--resume=true"])
    shared = apply_preset(["--preset=cpu", "--policy.repo_id=me/policy"])

    kept = ("--policy.type", "--policy.vision_width", "--policy.n_memory_steps", "--policy.action_range")
    assert not any(arg.startswith(kept) for arg in tuned)

    assert f"--batch_size={preset_options('cpu')['batch_size']}" in tuned
    assert resumed == ["--preset=cpu", "--resume=true"]
    assert "--policy.push_to_hub=false" not in shared


@pytest.mark.parametrize("capable", [False, True])
def test_the_cpu_preset_computes_in_bfloat16_where_that_is_faster(monkeypatch, capable):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": capable}, raising=False)

    assert ("--policy.use_amp=true" in apply_preset(["--preset=cpu"])) == capable
    assert "--policy.use_amp=true" not in apply_preset(["--preset=cpu", "--policy.use_amp=false"])
    assert "--policy.use_amp=true" not in apply_preset(["--preset=paper"])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_options_that_exist_and_configuration_files_as_well(name, monkeypatch, noise):
    seen = []
    monkeypatch.setattr(PlaybyearTrainConfig, "validate", lambda cfg: seen.append(cfg) or 1 / 0)
    for options in ((f"--preset={name}", "--policy.use_amp=false"), (f"--config_path={RECIPES / name}.json",)):
        with pytest.raises(ZeroDivisionError):
            run_in_process(train, *options, *data(noise))
    by_name, by_file = seen
    assert by_name.steps == int(preset_options(name)["steps"])
    assert by_name.preset == name
    by_name.preset = None
    assert by_name == by_file


@pytest.mark.slow
def test_a_run_from_the_disk_resumes_from_there_and_sees_shrunk_pictures(tmp_path):
    make_dataset(tmp_path / "data", (12, 17), image_size=48)
    options = (*TINY, *data(tmp_path / "data"), "--store=disk", f"--store.cache={tmp_path / 'cache'}")
    run_in_process(train, *options, "--steps=2", f"--output_dir={tmp_path / 'out'}")
    (folder,) = (path for path in (tmp_path / "cache").iterdir() if path.is_dir())
    assert np.load(folder / "0.npy", mmap_mode="r").shape == (29, 3, 16, 16)
    last = tmp_path / "out" / "checkpoints" / "last"
    run_in_process(train, "--resume=true", f"--config_path={config_of(last)}", "--steps=3")
    assert step_of(last.resolve()) == 3
    assert [path for path in (tmp_path / "cache").iterdir() if path.is_dir()] == [folder]
