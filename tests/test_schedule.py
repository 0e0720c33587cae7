"""The published recipe to the letter, and what becomes of the learning rate of a run that is to go on for longer."""

import json

import pytest
from dataset_factory import dataset_features, make_dataset
from lerobot.scripts import lerobot_train
from support.shared import run_in_process

from lerobot_playbyear.scripts.commands import train
from lerobot_playbyear.training.config import PlaybyearTrainConfig

pytestmark = pytest.mark.usefixtures("one_thread")

TINY = ("--policy.device=cpu", "--policy.push_to_hub=false", "--policy.audio_window_s=0.9", "--num_workers=0")


# The published recipe

PUBLISHED = {
    # inputs
    "use_vision": True,
    "use_audio": True,
    "use_memory": True,
    "image_size": 224,
    "n_frame_stack": 3,
    "n_memory_steps": 10,
    "audio_window_s": 2.0,
    "segment_s": 0.040,
    "hop_s": 0.035,
    "n_frequency_bins": 160,
    # network: ResNet-18, 160 -> 64 -> 32 -> 16 -> 8 channels, plain concatenation, 2 x 1,024 -> 50
    "vision_width": 64,
    "audio_channels": (64, 32, 16, 8),
    "normalize_encodings": False,
    "low_dimensional_gain": 1.0,
    "hidden_size": 1024,
    "embedding_size": 50,
    # the last action of one window; augmentation of images alone
    "n_supervised_steps": 1,
    "augmentation_crop": 4.0,
    "augmentation_brightness": 0.05,
    "augmentation_hue": 0.05,
    "augmentation_degrees": 5.0,
    "augmentation_translate": 0.05,
    "augmentation_scale": 0.05,
    "audio_noise_db": None,
    "memory_displacement_gain": 0.0,
    "low_dimensional_noise": 0.0,
    "low_dimensional_offset": 0.0,
    # Adam
    "optimizer_lr": 1e-3,
    "optimizer_weight_decay": 0.0,
    "use_amp": False,
}


def test_the_preset_paper_is_the_published_recipe_to_the_letter(monkeypatch):
    seen = []
    monkeypatch.setattr(PlaybyearTrainConfig, "validate", lambda cfg: seen.append(cfg) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_in_process(train, "--preset=paper", "--dataset.repo_id=tests/noise")
    (cfg,) = seen
    assert {name: getattr(cfg.policy, name) for name in PUBLISHED} == PUBLISHED
    assert (cfg.batch_size, cfg.steps) == (16, 100_000)


def test_the_preset_paper_keeps_adams_rate_constant_and_never_clips(noise, tmp_path):
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={noise}")
    small = ("--policy.image_size=16", "--policy.vision_width=4", "--policy.hidden_size=32")
    run = ("--steps=4", "--log_freq=1", f"--output_dir={tmp_path / 'out'}")
    run_in_process(train, "--preset=paper", *TINY, *data, *small, *run)

    lines = [json.loads(line) for line in (tmp_path / "out/metrics.jsonl").read_text().splitlines()]
    saved = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/train_config.json").read_text())
    assert [line["lr"] for line in lines] == [1e-3] * 4
    assert saved["scheduler"] is None
    adam = {"type": "adam", "lr": 1e-3, "betas": [0.9, 0.999], "eps": 1e-8, "weight_decay": 0.0}
    assert saved["optimizer"] == {**adam, "grad_clip_norm": 0.0}


# Going on for longer


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A dataset, and the `train_config.json` of the last checkpoint of a run of ten updates, whose rate has fallen."""
    folder = tmp_path_factory.mktemp("run")
    make_dataset(folder / "data", (15, 12), features=dataset_features(cameras=(), microphones=()))
    data = ("--dataset.repo_id=tests/noise", f"--dataset.root={folder / 'data'}")
    blind_and_deaf = ("--policy.type=playbyear", "--policy.use_vision=false", "--policy.use_audio=false")
    run = ("--policy.n_supervised_steps=2", "--steps=10", "--save_freq=5", "--batch_size=2", "--log_freq=1")
    run_in_process(train, *TINY, *data, *blind_and_deaf, *run, f"--output_dir={folder / 'out'}")
    return folder / "out/checkpoints/last/pretrained_model/train_config.json"


def jumps(capfd):
    """The warnings since the last time; LeRobot's logging writes them."""
    return [line for line in "\n".join(capfd.readouterr()).splitlines() if "The learning rate rises" in line]


@pytest.mark.slow
@pytest.mark.parametrize(
    "script",
    [train, pytest.param(lerobot_train.train, marks=pytest.mark.slow)],
    ids=["playbyear-train", "lerobot-train"],
)
def test_a_rate_that_rises_because_the_run_shall_be_longer_is_said(script, trained, tmp_path, capfd):
    resumed = ("--resume=true", f"--config_path={trained}", "--steps=20")

    run_in_process(script, *resumed, f"--output_dir={tmp_path / 'out'}")

    (message,) = jumps(capfd)
    assert "planned for 10 updates" in message
    assert "from 1e-05 to 0.000505" in message
    advice = message.split("add ")[1].split()
    assert advice[:2] == ["--scheduler.num_warmup_steps=0", "--scheduler.num_decay_steps=10"]
    run_in_process(script, *resumed, *advice[:2], f"--output_dir={tmp_path / 'low'}")
    assert not jumps(capfd)
    state = json.loads((tmp_path / "low/checkpoints/last/training_state/scheduler_state.json").read_text())
    assert state["_last_lr"] == [pytest.approx(1e-5)]
