"""The examples run as they are printed."""

import os
import subprocess
import sys
import wave
from pathlib import Path

import pytest
from dataset_factory import make_dataset

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(*command: str | Path) -> str:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    result = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, env={**os.environ, "PATH": path}, check=False
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def test_plain_gymnasium_hears_the_touch():
    printed = run(sys.executable, EXAMPLES / "play_in_gymnasium.py")
    assert "Solved after" in printed
    assert "sweep" in printed


def test_a_dataset_is_heard_as_wav(tmp_path):
    make_dataset(tmp_path / "noise", (12,), image_size=16)
    run(
        sys.executable,
        EXAMPLES / "listen_to_dataset.py",
        "--repo_id=local/noise",
        f"--root={tmp_path / 'noise'}",
        f"--output_dir={tmp_path}",
    )
    with wave.open(str(tmp_path / "episode_0_gripper.wav")) as file:
        assert file.getframerate() == 16000
        assert file.getnframes() == 12 * 800


@pytest.mark.slow
def test_own_robot_trains(tmp_path):
    run(sys.executable, EXAMPLES / "own_robot.py", f"--root={tmp_path / 'robot'}", "--frames=40")
    run(
        "playbyear-train",
        "--policy.type=playbyear",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        "--policy.fps=30",
        "--policy.image_size=32",
        "--policy.vision_width=4",
        "--dataset.repo_id=me/own_robot",
        f"--dataset.root={tmp_path / 'robot'}",
        "--batch_size=2",
        "--steps=2",
        f"--output_dir={tmp_path / 'train'}",
    )
    config = PlaybyearConfig.from_pretrained(tmp_path / "train/checkpoints/last/pretrained_model")
    assert len(config.camera_keys) == len(config.audio_keys) == 2
    assert config.sample_rate == 48000


@pytest.mark.timeout(900)
def test_the_main_job_with_lerobots_own_commands(tmp_path):
    run("bash", EXAMPLES / "by_hand.sh", tmp_path)
    assert (tmp_path / "eval" / "eval_info.json").exists()
