"""Nothing stays in the system's temporary folder: neither of a command, nor of the sound server that tests hear with."""

import re
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from dagger_factory import QUICK, arguments
from sound_server import RATE, Player, started, why_not
from support.shared import ENV, TINY, recorded, run_in_process, trained

from lerobot_playbyear.scripts import commands


@pytest.fixture
def system(monkeypatch):
    """The system's temporary folder, and a home; both are empty."""
    with tempfile.TemporaryDirectory() as folder:  # a socket's path is short
        for name in ("tmp", "home"):
            Path(folder, name).mkdir()
        monkeypatch.setattr(tempfile, "tempdir", f"{folder}/tmp")
        monkeypatch.setenv("TMPDIR", f"{folder}/tmp")
        monkeypatch.setenv("HOME", f"{folder}/home")
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", f"{folder}/compiled")
        yield Path(folder)


def left(system: Path) -> list[str]:
    return sorted(str(path.relative_to(system)) for name in ("tmp", "home") for path in (system / name).rglob("*"))


DEMOS = ("--dataset.repo_id=tests/demos", "--steps=1")


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("dagger", lambda out: arguments(out, *QUICK, "--num_episodes=2")),
        ("dagger", lambda out: arguments(out, *QUICK, "--policy.action_range=2")),  # is refused
        ("train", lambda out: [*TINY, *DEMOS, f"--dataset.root={recorded()}", f"--output_dir={out}/train"]),
        (
            "video",
            lambda out: [*ENV, f"--policy.path={trained()}", "--env.episode_length=3", f"--output={out}/film.mp4"],
        ),
    ],
)
def test_a_command_leaves_nothing(command, options, system, tmp_path):
    given = options(tmp_path)  # makes what the command needs
    before = left(system)
    ended = run_in_process(getattr(commands, command), *given)
    assert ended is None or "action_range=2" in ended
    assert left(system) == before
    assert tempfile.gettempdir() == str(system / "tmp")


@pytest.mark.parametrize("command", ["train", "inspect", "repair"])
def test_a_temporary_folder_that_cannot_be_written_is_told_in_one_line(command, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "file"))
    named = [f"--root={recorded()}"] if command == "repair" else ["--dataset.repo_id=tests/demos"]
    ended = run_in_process(getattr(commands, command), *named)
    assert re.fullmatch(r"error: The system's temporary folder cannot be written: .*file.*: TMPDIR=\.\.\.", ended)
    assert tempfile.tempdir == str(tmp_path / "file")


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_the_sound_server_and_who_hears_it_leave_nothing(system, tmp_path):
    with started(bench=1) as server, Player(server.fifo("bench"), 1) as player:
        player.play(np.full(RATE, 3000, np.int16), time.perf_counter())
        given = ("--seconds=0.2", f"--output_dir={tmp_path}")
        assert run_in_process(commands.find_microphones, *given) is None
    assert (tmp_path / "microphone_0.wav").is_file()
    assert left(system) == []
