"""Several processes learn what one with all their data learns."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import shared

AUGMENTATIONS = ("crop", "brightness", "hue", "degrees", "translate", "scale")
WITHOUT_CHANCE = tuple(f"--policy.augmentation_{name}=0" for name in AUGMENTATIONS)
"""Augmentation is drawn per process; without it two processes see what one does."""


TINY = (*shared.TINY, *WITHOUT_CHANCE, "--log_freq=1", "--seed=3")


def launch(n_processes: int, program: str, *options: object) -> str:
    """Runs a program in several processes through the real launcher, one thread each; what it printed."""
    folder = Path(sys.executable).parent
    command = [str(folder / program), *map(str, options)]
    if n_processes > 1:
        processes = ("--multi_gpu", f"--num_processes={n_processes}", "--num_machines=1", "--main_process_port=0")
        plain = ("--mixed_precision=no", "--dynamo_backend=no")
        command = [str(folder / "accelerate"), "launch", *processes, *plain, *command]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    output = result.stdout + result.stderr
    assert result.returncode == 0, output[-4000:]
    return output


def figures(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == kind]


@pytest.mark.slow
def test_training_in_two_processes_learns_what_one_with_twice_the_batch_learns(tmp_path, noise):
    """Over 20 updates, from stores on the disk that one of the two makes, with one checkpoint and one line per update."""
    options = ("--dataset.repo_id=tests/noise", "--dataset.eval_split=0.5", "--eval_steps=10")
    data = (f"--dataset.root={noise}", *options)
    losses = {}
    for n_processes in (2, 1):
        folder, cache = tmp_path / str(n_processes), tmp_path / f"cache{n_processes}"
        store = ("--store=disk", f"--store.cache={cache}")
        options = (*TINY, *data, *store, "--steps=20", "--save_freq=10", f"--batch_size={8 // n_processes}")
        launch(n_processes, "playbyear-train", *options, f"--output_dir={folder}")
        losses[n_processes] = [line["loss"] for line in figures(folder, "train")]
        assert [line["step"] for line in figures(folder, "train")] == list(range(1, 21))
        assert [line["step"] for line in figures(folder, "validation")] == [10, 20]
        assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["000010", "000020", "last"]
        assert len([path for path in cache.iterdir() if path.is_dir()]) == 2
    assert losses[2] == pytest.approx(losses[1], rel=2e-3)
    last = tmp_path / "2" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    launch(2, "playbyear-train", "--resume=true", f"--config_path={last}", "--steps=22")
    assert figures(tmp_path / "2", "train")[-1]["step"] == 22
