"""Datasets, checkpoints and runs that version 0.1.0 left on the disk are read and gone on with (`old_formats/make.py`)."""

import json
import shutil
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train
from old_formats.make import ENV, act
from safetensors.torch import load_file

from lerobot_playbyear.datasets import run_weights
from lerobot_playbyear.scripts import dagger, inspect, record, repair, train
from lerobot_playbyear.training import loop

pytestmark = pytest.mark.usefixtures("one_thread")

ARCHIVE = Path(__file__).parent / "old_formats" / "0.1.0.tar.gz"
CHECKPOINT = Path("train/checkpoints/000004")
FIGURES = ("loss", "grad_norm")
"""Of a line of figures: what tells whether weights, optimizer and random numbers are those that were saved."""


@pytest.fixture(autouse=True)
def old(tmp_path, monkeypatch) -> Path:
    """What 0.1.0 left, unpacked into the current folder: the paths in it are relative."""
    with tarfile.open(ARCHIVE) as file:
        file.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def command(monkeypatch):
    """Runs a command in this process. Returns its exit status, 0 where it only returns."""

    def run(main, *arguments) -> int:
        monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
        try:
            main()
        except SystemExit as end:
            if isinstance(end.code, str):
                pytest.fail(end.code)
            return int(end.code or 0)
        return 0

    return run


def lines(path: str, *kinds: str) -> list[dict]:
    """The lines of a file of figures, of some kinds."""
    return [line for line in map(json.loads, Path(path).read_text().splitlines()) if line["kind"] in kinds]


def step_of(checkpoint: Path) -> int:
    return json.loads((checkpoint / "training_state/training_step.json").read_text())["step"]


def columns(root: str, episodes: list[int]) -> dict[str, np.ndarray]:
    """All of some episodes but for the pictures, each column (N, ...)."""
    data = LeRobotDataset("old/data", root=root, video_backend="pyav").hf_dataset.with_format("numpy")
    wanted = np.isin(np.asarray(data["episode_index"]), episodes)
    return {key: np.stack(list(data[key]))[wanted] for key in data.column_names if "images" not in key}


def test_an_old_checkpoint_acts_as_it_did():
    expected = np.load("expected/actions.npy", allow_pickle=False)

    actions = act(CHECKPOINT / "pretrained_model")

    # No tighter, as each kind of processor adds up in its own order; a picture or a sound one frame late makes 1e-3.
    np.testing.assert_allclose(actions, expected, rtol=0, atol=1e-5)


def twice_as_often_at_the_start(store, n_windows, n_dropped):
    """As the run drew, whose `--sampling.start_weight` was 2: the first half second counts twice."""
    weights = torch.ones(len(store))
    for start in store.starts:
        weights[start : start + 10] = 2
    return run_weights(store, n_windows, weights, n_dropped)


def test_an_old_training_run_goes_on_as_if_it_had_not_stopped(command, monkeypatch, caplog):
    monkeypatch.setattr(loop, "run_weights", twice_as_often_at_the_start)
    config = CHECKPOINT / "pretrained_model/train_config.json"

    command(train.main, "--resume=true", f"--config_path={config}")

    assert "options that there are no longer; they are left out: {'sampling': {'start_weight': 2.0" in caplog.text
    assert step_of(Path("train/checkpoints/last").resolve()) == 6
    made, expected = lines("train/metrics.jsonl", "train"), lines("expected/train_metrics.jsonl", "train")
    assert [line["step"] for line in made] == [1, 2, 3, 4, 5, 6]
    for ours, theirs in zip(made, expected, strict=True):
        assert ours["lr"] == pytest.approx(theirs["lr"])
        assert [ours[key] for key in FIGURES] == pytest.approx([theirs[key] for key in FIGURES], rel=1e-3)


def test_lerobot_train_goes_on_with_an_old_training_run(command):
    config = CHECKPOINT / "pretrained_model/train_config.json"

    command(lerobot_train.train, "--resume=true", f"--config_path={config}", "--steps=5")

    after = Path("train/checkpoints/000005")
    assert step_of(after) == 5
    weights = [load_file(path / "pretrained_model/model.safetensors") for path in (CHECKPOINT, after)]
    moved = [(weights[1][key] - values).abs().max() for key, values in weights[0].items() if "lstm" in key]
    assert 0 < max(moved) < 0.05  # one update of the saved weights; others differ from them ten times as much


@pytest.mark.parametrize("root", ["demos", "corrections"])
def test_nothing_is_found_wrong_with_old_datasets(command, root, capsys):
    assert command(repair.main, f"--root={root}", "--dry_run=true") == 0
    assert "2 episodes, nothing wrong" in capsys.readouterr().out
    assert command(inspect.main, "--dataset.repo_id=old/data", f"--dataset.root={root}") == 0


def test_an_old_dataset_gets_another_episode_and_keeps_those_it_has(command):
    before = columns("demos", [0, 1])
    data = ("--dataset.repo_id=old/demos", "--dataset.root=demos")

    command(record.main, *ENV, *data, "--dataset.num_episodes=3", "--num_workers=0", "--resume=true")

    after = columns("demos", [0, 1])
    assert after.keys() == before.keys()
    for key, values in before.items():
        np.testing.assert_array_equal(after[key], values, err_msg=key)
    assert columns("demos", [2])["seed"].min() > before["seed"].max()
    assert command(repair.main, "--root=demos", "--dry_run=true") == 0


def test_an_old_run_of_hg_dagger_goes_on_and_ends(command):
    """The attempt that it had not counted is counted and learned from; then a third one is made."""
    shutil.rmtree("train")  # its own checkpoint is all it needs

    command(dagger.main, "--resume=true", "--output_dir=dagger")

    made, expected = lines("dagger/metrics.jsonl", "round"), lines("expected/dagger_metrics.jsonl", "round")
    assert [line["round"] for line in made] == [line["round"] for line in expected] == [1, 2]
    assert [made[1][key] for key in FIGURES] == pytest.approx([expected[1][key] for key in FIGURES], rel=1e-3)
    attempts = lines("dagger/metrics.jsonl", "attempt")
    assert [line["attempt"] for line in attempts] == [1, 2]
    assert [line.get("recovered", False) for line in attempts] == [False, True]

    command(dagger.main, "--resume=true", "--output_dir=dagger", "--episodes=3")

    state = json.loads(Path("dagger/dagger_state.json").read_text())
    assert (state["round"], state["kept"], state["step"]) == (3, 3, 6)
    assert len(np.unique(columns("corrections", [0, 1, 2])["seed"])) == 3
    assert step_of(Path("dagger/checkpoints/last").resolve()) == 6
