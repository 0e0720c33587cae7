"""The examples run as they are printed."""

import os
import subprocess
import sys
import wave
from pathlib import Path

import pytest
from dataset_factory import make_dataset

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


@pytest.mark.timeout(900)
def test_the_main_job_with_lerobots_own_commands(tmp_path):
    run("bash", EXAMPLES / "by_hand.sh", tmp_path)
    assert (tmp_path / "eval" / "eval_info.json").exists()
