"""The examples run as they are printed."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest
from dataset_factory import make_dataset
from nbclient import NotebookClient
from recording_factory import load
from safetensors.torch import load_file
from support.pages import ROOT, blocks

from lerobot_playbyear.audio import read_audio
from lerobot_playbyear.datasets import episode_waveform
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.film.video import write_film

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def run(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)  # as where `python examples/...` is called

    def call(name: str, *arguments: str | Path) -> None:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")

    return call


@pytest.mark.timeout(300)  # LeRobot is imported, records, trains and evaluates: a minute and a half on a busy machine
def test_the_main_job_with_lerobots_own_commands(commands, tmp_path):
    """bash says which commands the script runs, and they are run."""
    programs, said = tmp_path / "programs", tmp_path / "said"
    programs.mkdir()
    for name in ("playbyear-record", "lerobot-train", "lerobot-eval"):
        tell = f"import json, sys; print(json.dumps(['{name}', *sys.argv[1:]]), file=open('{said}', 'a'))"
        (programs / name).write_text(f'#!/bin/bash\n{sys.executable} -c "{tell}" "$@"\n')
        (programs / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    subprocess.run(["bash", EXAMPLES / "by_hand.sh", tmp_path], check=True, env=environment)

    for line in said.read_text().splitlines():
        commands.succeed(*json.loads(line))

    assert json.loads((tmp_path / "eval/eval_info.json").read_text())["overall"]["n_episodes"] == 1


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(tmp_path, monkeypatch):
    """With three demonstrations and two updates; as committed it has no outputs, and so none of somebody's machine."""
    notebook = nbformat.read(EXAMPLES / "quickstart.ipynb", nbformat.NO_CONVERT)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.outputs for cell in cells] == [[]] * len(cells)
    sizes = {"EPISODES=50": "EPISODES=3", "UPDATES=1250": "UPDATES=2", "TRIALS=20": "TRIALS=1"}
    for usual, small in sizes.items():
        assert usual in cells[0].source
        cells[0].source = cells[0].source.replace(usual, small)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": tmp_path}}).execute()
    assert "of 1 episodes" in str(cells[-3].outputs)
    assert "data:video/mp4;base64" in str(cells[-1].outputs)


def test_plain_gymnasium_hears_the_touch(run, capsys):
    run("play_in_gymnasium.py")
    printed = capsys.readouterr().out
    assert "Solved after" in printed
    assert "sweep" in printed


def test_an_environment_of_ones_own_is_recorded_and_two_recordings_merge(run, tmp_path, capsys):
    run("record_own_environment.py", f"--root={tmp_path / 'one'}", "--episodes=1")
    run("record_own_environment.py", f"--root={tmp_path / 'one'}", "--episodes=2")  # goes on
    run("record_own_environment.py", f"--root={tmp_path / 'two'}", "--episodes=1")
    assert "Episode 1 is safe." in capsys.readouterr().out

    merged = tmp_path / "merged"
    run("merge_recordings.py", "--roots", tmp_path / "one", tmp_path / "two", f"--root={merged}", "--repo_id=me/both")

    assert "3 episodes" in capsys.readouterr().out
    assert survey(merged).is_undamaged
    for episode, (root, its) in enumerate([("one", 0), ("one", 1), ("two", 0)]):
        waveform, rate = episode_waveform(load(merged), episode, "observation.audio.finger")
        np.testing.assert_array_equal(
            waveform, episode_waveform(load(tmp_path / root), its, "observation.audio.finger")[0]
        )
        assert rate == 16000
    assert np.abs(waveform).max() > 4000  # it knocked
    run("listen_to_dataset.py", "--repo_id=me/both", f"--root={merged}", f"--output_dir={tmp_path}")
    samples, _ = read_audio(tmp_path / "episode_0_finger.wav")
    np.testing.assert_array_equal(samples[:, 0], episode_waveform(load(merged), 0, "observation.audio.finger")[0])


def test_a_folder_of_films_becomes_a_dataset(run, tmp_path, capsys):
    films = tmp_path / "films"
    films.mkdir()
    for name, n_frames, flash in (("a", 60, 30), ("b", 45, 15)):
        pictures = [np.full((96, 96, 3), 255 if i == flash else 30, np.uint8) for i in range(n_frames)]
        sound = np.zeros((n_frames * 1600, 2), np.int16)
        sound[flash * 1600 - 100 : flash * 1600] = 20000  # a click at the same time
        write_film(films / f"{name}.mp4", pictures, 30, sound, 48000)
        n_rows = n_frames * 20 // 30
        np.savetxt(films / f"{name}.csv", np.arange(2 * n_rows).reshape(n_rows, 2), delimiter=",")
    root = tmp_path / "dataset"

    run("videos_to_dataset.py", f"--films={films}", f"--root={root}", "--task=Knock.")

    assert "b.mp4: episode 1, 1.5 s" in capsys.readouterr().out
    dataset = load(root)
    assert [int(length) for length in dataset.meta.episodes["length"]] == [40, 30]
    assert survey(root).is_undamaged
    for episode, flash in ((0, 20), (1, 10)):
        first = dataset.meta.episodes[episode]["dataset_from_index"]
        items = [dataset[first + i] for i in range(dataset.meta.episodes[episode]["length"])]
        assert max(range(len(items)), key=lambda i: items[i]["observation.images.camera"].mean()) == flash
        loudness = [np.abs(item["observation.audio.camera"].numpy().astype(int)).max() for item in items]
        assert int(np.argmax(loudness)) == flash  # heard by the time of the picture
        np.testing.assert_array_equal(items[3]["action"].numpy(), [6, 7])


def test_act_begins_with_cut_pictures_and_keeps_cutting_them(run, commands, tmp_path):
    root, start = tmp_path / "demos", tmp_path / "start"
    make_dataset(root, (12,), image_size=32)
    small = ("dim_model=32", "n_heads=2", "dim_feedforward=32", "chunk_size=4", "n_action_steps=4", "latent_dim=4")
    run("start_act.py", root, start, "--crop", "front=0,8,32,16", "--size=32", *small)

    command = ("lerobot-train", f"--policy.path={start}", "--policy.push_to_hub=false", "--dataset.repo_id=tests/noise")
    places = (f"--dataset.root={root}", "--dataset.video_backend=pyav", f"--output_dir={tmp_path / 'train'}")
    commands.succeed(*command, *places, "--steps=1", "--batch_size=2", "--num_workers=0", "--policy.device=cpu")

    trained = tmp_path / "train/checkpoints/last/pretrained_model"
    first, *_ = json.loads((trained / "policy_preprocessor.json").read_text())["steps"]
    assert first["registry_name"] == "image_crop_resize_processor"
    cut = {"observation.images.front": [0, 8, 32, 16]}
    assert first["config"] == {"crop_params_dict": cut, "resize_size": [32, 32]}
    means = [value for key, value in load_file(trained / "model.safetensors").items() if key.endswith("running_mean")]
    assert all(value.abs().max() > 0 for value in means)  # the frozen norms know what they see


def test_the_pages_programs_run(tmp_path, monkeypatch, capsys):
    """Every Python block of two pages, in a folder that holds the datasets which they name."""
    monkeypatch.chdir(tmp_path)
    for root in ("outputs/demo/dataset", "outputs/occluded"):
        make_dataset(tmp_path / root, (12,), image_size=16, repo_id="demo/occluded")
    pages = {"reference/dataset_format.md": 4, "how_to/inspect_repair_hub.md": 1}
    for name, n_blocks in pages.items():
        programs = blocks(ROOT / "docs" / name, "python")
        assert len(programs) == n_blocks
        for program in programs:
            exec(compile(program, name, "exec"), {})
    assert capsys.readouterr().out.startswith("info []")
    assert read_audio("episode_0.flac")[0].shape == (12 * 800, 1)
    assert load(tmp_path / "outputs/knocks").num_frames == 60
