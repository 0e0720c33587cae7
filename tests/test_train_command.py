"""playbyear-train learns what lerobot-train learns, and either continues the other's checkpoints."""

import json

import numpy as np
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, make_dataset
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from support import shared
from torch.utils.data import default_collate

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.scripts.commands import train as train_script
from lerobot_playbyear.training import EpisodeStore
from lerobot_playbyear.training import train as loop
from lerobot_playbyear.training.batches import PolicyWindows, runs_of_each_frame
from lerobot_playbyear.training.command_line import PRESETS, RECIPES, apply_preset, preset_options, with_long_store
from lerobot_playbyear.training.config import PlaybyearTrainConfig, StoreConfig
from lerobot_playbyear.training.learner import noise_seed

pytestmark = pytest.mark.usefixtures("one_thread")

train = parser.wrap()(loop.train)

FPS = 20
TINY = (*(option for option in shared.TINY if "n_supervised" not in option), "--log_freq=2")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, (12, 17, 9, 14), image_size=16)
    return root


@pytest.fixture
def command():
    """Runs a training script in this process, as the command line would."""
    return shared.run_in_process


def data(root):
    return "--dataset.repo_id=tests/noise", f"--dataset.root={root}"


def config_of(checkpoint):
    return checkpoint / "pretrained_model" / "train_config.json"


def step_of(checkpoint):
    return json.loads((checkpoint / "training_state" / "training_step.json").read_text())["step"]


def weights_of(checkpoint):
    return load_file(checkpoint / "pretrained_model" / "model.safetensors")


@pytest.fixture(scope="module")
def trained(root, tmp_path_factory):
    """The output folder of a run of six updates with checkpoints every three."""
    output = tmp_path_factory.mktemp("run") / "out"
    options = ("--steps=6", "--save_freq=3", "--store.place=memory")
    validation = ("--dataset.eval_split=0.25", "--eval_steps=3", "--policy.n_supervised_steps=4")
    shared.run_in_process(train, *TINY, *data(root), *options, *validation, f"--output_dir={output}")
    return output


def test_a_run_leaves_lerobots_checkpoints_and_its_figures(trained):
    checkpoints = trained / "checkpoints"
    lines = [json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines()]

    assert sorted(path.name for path in checkpoints.iterdir()) == ["000003", "000006", "last"]
    assert (checkpoints / "last").resolve().name == "000006"
    assert [(line["kind"], line["step"]) for line in lines] == [
        ("train", 2),
        ("validation", 3),
        ("train", 4),
        ("train", 6),
        ("validation", 6),
    ]
    assert all(torch.isfinite(torch.tensor(line["loss"])) for line in lines)
    PlaybyearPolicy.from_pretrained(checkpoints / "last" / "pretrained_model")


def test_its_options_are_kept_where_lerobot_does_not_stumble_over_them(trained):
    path = config_of(trained / "checkpoints" / "last")

    stock = TrainPipelineConfig.from_pretrained(path)
    ours = PlaybyearTrainConfig.from_pretrained(path, cli_args=["--store.device=cpu"])

    assert (stock.steps, stock.policy.type) == (6, "playbyear")
    assert ours.store == StoreConfig(place="memory", device="cpu")


def test_measuring_held_out_episodes_changes_nothing_that_is_learned(trained, root, command, tmp_path):
    held_out = ("--dataset.eval_split=0.25", "--eval_steps=0", "--policy.n_supervised_steps=4")
    command(train, *TINY, *data(root), "--steps=6", *held_out, f"--output_dir={tmp_path / 'out'}")
    ours, theirs = (weights_of(folder / "checkpoints" / "last") for folder in (tmp_path / "out", trained))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_a_policy_is_tuned_with_sound_of_another_rate(trained, command, tmp_path):
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    sample_rate = json.loads((policy / "config.json").read_text())["sample_rate"]
    make_dataset(tmp_path / "faster", (12, 9), image_size=16, sample_rate=3 * sample_rate)
    options = ("--policy.push_to_hub=false", "--num_workers=0", "--steps=1", "--batch_size=2")
    output = tmp_path / "out"
    command(train, f"--policy.path={policy}", *data(tmp_path / "faster"), *options, f"--output_dir={output}")
    tuned = json.loads((output / "checkpoints/last/pretrained_model/config.json").read_text())
    assert tuned["sample_rate"] == sample_rate


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(trained, command, tmp_path):
    half = trained / "checkpoints" / "000003"

    command(train, "--resume=true", f"--config_path={config_of(half)}", f"--output_dir={tmp_path}")

    resumed = weights_of(tmp_path / "checkpoints" / "last")
    expected = weights_of(trained / "checkpoints" / "last")
    assert all(torch.equal(resumed[key], expected[key]) for key in expected)


def test_of_several_processes_a_resumed_one_draws_other_noise_than_at_the_begin():
    seeds = [noise_seed(1000, process, step) for process in (0, 1) for step in (0, 3, 6)]
    assert seeds[::3] == [1000, 1001]
    assert len(set(seeds)) == 6


def test_lerobot_train_and_playbyear_train_continue_each_other(trained, command, tmp_path):
    ours = trained / "checkpoints" / "last"

    options = ("--resume=true", f"--config_path={config_of(ours)}", "--steps=7", f"--output_dir={tmp_path}")
    command(lerobot_train.train, *options)
    theirs = tmp_path / "checkpoints" / "last"
    assert step_of(theirs.resolve()) == 7
    command(train, "--resume=true", f"--config_path={config_of(theirs)}", "--steps=8")

    assert step_of(theirs.resolve()) == 8


def test_a_checkpoint_is_fine_tuned_with_a_preset_that_leaves_its_network_alone(trained, root, command, tmp_path):
    policy = trained / "checkpoints" / "last" / "pretrained_model"
    options = ("--preset=cpu", "--steps=1", "--batch_size=2", "--policy.use_amp=false")

    command(train_script, f"--policy.path={policy}", *data(root), *options, f"--output_dir={tmp_path / 'out'}")

    tuned = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    assert (tuned["image_size"], tuned["vision_width"]) == (16, 4)
    assert (tuned["n_memory_steps"], tuned["action_range"]) == (2, 1.0)
    assert tuned["n_supervised_steps"] == int(preset_options("cpu")["policy.n_supervised_steps"])


def test_its_batches_give_the_loss_of_lerobots(trained, root):
    policy = PlaybyearPolicy.from_pretrained(trained / "checkpoints" / "last" / "pretrained_model")
    config = policy.config
    preprocessor, _ = make_pre_post_processors(config, str(trained / "checkpoints" / "last" / "pretrained_model"))
    timestamps = {key: [i / FPS for i in config.observation_delta_indices] for key in config.input_features}
    timestamps["action"] = [i / FPS for i in config.action_delta_indices]
    stock = LeRobotDataset("tests/noise", root, delta_timestamps=timestamps)
    windows = PolicyWindows(config, stock.meta)
    store = EpisodeStore.from_dataset(stock, windows.keys, device="cpu")
    frames = [0, 1, 5, 12, 28, 51]

    batch = windows.batch(store, torch.tensor(frames))
    theirs, _ = policy(preprocessor(default_collate([stock[i] for i in frames])))
    ours, _ = policy(preprocessor(batch))

    assert (batch[CAMERA].dtype, batch[MICROPHONE].dtype) == (torch.uint8, torch.int16)
    assert batch["observation.state"].shape[1] == config.n_run_frames
    assert torch.allclose(ours, theirs, rtol=0, atol=1e-6)


def test_the_policy_is_rolled_out_while_it_trains(trained, command, tmp_path):
    pytest.importorskip("lerobot_env_playbyear")
    rollouts = ("--env.type=playbyear", "--env.episode_length=4", "--env_eval_freq=100", "--eval.n_episodes=1")
    checkpoint = f"--config_path={config_of(trained / 'checkpoints' / 'last')}"

    command(train, "--resume=true", checkpoint, "--steps=7", *rollouts, f"--output_dir={tmp_path}")

    last = json.loads((tmp_path / "metrics.jsonl").read_text().splitlines()[-1])
    assert (last["kind"], last["step"], last["pc_success"]) == ("eval", 7, 0)
    assert list((tmp_path / "eval").rglob("*.mp4"))


def test_held_out_frames_are_as_many_as_asked_for(root, command, tmp_path, monkeypatch):
    measured = []

    def measure(store, n_windows, chosen):
        measured.append((len(store), n_windows, runs_of_each_frame(store, n_windows, chosen).tolist()))
        return runs_of_each_frame(store, n_windows, chosen)

    monkeypatch.setattr(loop, "runs_of_each_frame", measure)
    options = ("--dataset.eval_split=0.5", "--eval_steps=1", "--steps=1", "--policy.n_supervised_steps=4")
    command(train, *TINY, *data(root), *options, "--max_eval_samples=11", f"--output_dir={tmp_path / 'out'}")

    assert measured == [(23, 4, [8, 4, 0, 10])]  # episodes of 9 and 14 frames


def test_a_preset_gives_way_to_the_command_line_and_leaves_checkpoints_and_the_hub_alone():
    given = apply_preset(["--preset=cpu", "--steps=10", "--policy.image_size", "64"])
    assert "--policy.vision_width=16" in given
    told = [arg for arg in given if arg.startswith(("--steps", "--policy.image_size"))]
    assert told == ["--steps=10", "--policy.image_size"]
    tuned = apply_preset(["--preset=cpu", "--policy.path=somewhere"])
    resumed = apply_preset(["--preset=cpu", "--resume=true"])
    shared = apply_preset(["--preset=cpu", "--policy.repo_id=me/policy"])

    wider = apply_preset(["--preset=cpu", "--policy.path=somewhere", "--policy.action_range=1.5"])

    kept = ("--policy.type", "--policy.vision_width", "--policy.n_memory_steps", "--policy.action_range")
    assert not any(arg.startswith(kept) for arg in tuned)
    assert [arg for arg in wider if arg.startswith(kept)] == ["--policy.action_range=1.5"]
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
def test_presets_are_options_that_exist_and_configuration_files_as_well(name, command, monkeypatch, root):
    seen = []
    monkeypatch.setattr(PlaybyearTrainConfig, "validate", lambda cfg: seen.append(cfg) or 1 / 0)
    for options in ((f"--preset={name}", "--policy.use_amp=false"), (f"--config_path={RECIPES / name}.json",)):
        with pytest.raises(ZeroDivisionError):
            command(train_script, *options, *data(root))
    by_name, by_file = seen
    assert by_name.steps == int(preset_options(name)["steps"])
    assert by_name.preset == name
    by_name.preset = None
    assert by_name == by_file


@pytest.mark.parametrize("given", [["--store=disk"], ["--store", "disk"], ["--store.place=disk"]])
def test_where_frames_are_kept_has_a_short_name(given):
    assert with_long_store([*given, "--steps=3"]) == ["--store.place=disk", "--steps=3"]
    assert with_long_store(["--store=store.yaml"]) == ["--store=store.yaml"]


def test_a_run_from_the_disk_resumes_from_there_and_sees_shrunk_pictures(tmp_path, command):
    make_dataset(tmp_path / "data", (12, 17), image_size=48)
    options = (*TINY, *data(tmp_path / "data"), "--store=disk", f"--store.cache={tmp_path / 'cache'}")
    command(train_script, *options, "--steps=2", f"--output_dir={tmp_path / 'out'}")
    (folder,) = (path for path in (tmp_path / "cache").iterdir() if path.is_dir())
    assert np.load(folder / "0.npy", mmap_mode="r").shape == (29, 3, 16, 16)
    last = tmp_path / "out" / "checkpoints" / "last"
    command(train_script, "--resume=true", f"--config_path={config_of(last)}", "--steps=3")
    assert step_of(last.resolve()) == 3
    assert [path for path in (tmp_path / "cache").iterdir() if path.is_dir()] == [folder]
