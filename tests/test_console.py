"""What commands say is shown by whatever console there is, and what they cannot do is said in one line."""

import ctypes.util
import io
import os
import shutil
import sys
from pathlib import Path

import pytest
from dataset_factory import MICROPHONE
from support.commands import python
from support.recording import edit_info
from support.shared import TINY, run_in_process
from test_hostile import rename_feature, rename_task

from lerobot_playbyear.scripts.commands import attach_audio, attach_spectrogram, inspect, repair, train

pytestmark = pytest.mark.usefixtures("one_thread")

NAME = "Ларь → é 箱"
OWNED = "\x1b]0;owned\x07\x1b[2J\x9b1A"


@pytest.fixture
def root(noise, tmp_path) -> Path:
    return Path(shutil.copytree(noise, tmp_path / NAME))


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "cp437"])
def test_a_console_that_lacks_letters_ends_no_command(root, tmp_path, monkeypatch, encoding):
    """As `PYTHONIOENCODING` makes it, and Windows."""
    rename_feature(root, MICROPHONE, f"observation.audio.{NAME}")
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding, write_through=True))
    data, page, seen = ("--dataset.repo_id=a/b", f"--dataset.root={root}"), tmp_path / f"{NAME}.html", tmp_path / "seen"
    assert run_in_process(inspect, *data, f"--html={page}") == 0
    assert "</html>" in page.read_text(encoding="utf-8")
    assert run_in_process(repair, f"--root={root}", "--dry_run=true") == 0
    picture = ("--output.repo_id=a/c", f"--output.root={seen}", "--seconds=0.5", "--name=sound")
    assert run_in_process(attach_spectrogram, *data, *picture) is None
    told = shown.getvalue().decode(encoding)
    assert told.count("\\u2192") >= 3
    assert "Dataset: " in told


def test_names_of_strangers_command_no_terminal(root, tmp_path, capsys):
    """Whether a command ends well or with an error, and what it logs."""
    rename_feature(root, MICROPHONE, f"observation.audio.{OWNED}")
    rename_task(root, OWNED)
    edit_info(root, lambda info: info.update(robot_type=OWNED))
    data, out = ("--dataset.repo_id=a/b", f"--dataset.root={root}"), f"--output_dir={tmp_path / 'out'}"
    seen = ("--output.repo_id=a/c", f"--output.root={tmp_path / 'seen'}")
    files = (f"--files={tmp_path}/{{episode}}.wav", "--microphone=left")
    ends = [
        run_in_process(inspect, *data),
        run_in_process(repair, f"--root={root}", "--dry_run=true"),
        run_in_process(attach_spectrogram, *data, *seen, "--seconds=0.5", "--name=sound"),
        run_in_process(attach_audio, *data, *seen, *files),
        run_in_process(train, *TINY, *data, out, "--steps=1", "--policy.audio_window_s=0.5"),
        run_in_process(train, *TINY, *data, out, "--steps=1", "--policy.sample_rate=8001"),
    ]
    streams = capsys.readouterr()
    said = "".join([streams.out, streams.err, *map(str, ends)])
    assert said.count("owned") >= 4
    assert not {"\x1b", "\x07", "\x9b"} & set(said)


@pytest.mark.parametrize("fps", [1e-9, 0, -1, 1e300, float("nan"), "20", True])
def test_a_rate_of_frames_that_cannot_be_is_one_error_of_every_command(root, tmp_path, capsys, fps):
    edit_info(root, lambda info: info.update(fps=fps))
    data, out = ("--dataset.repo_id=a/b", f"--dataset.root={root}"), tmp_path / "out"
    heard = ("--output.repo_id=a/c", f"--output.root={out}")
    assert run_in_process(inspect, *data) == 2
    told = [
        capsys.readouterr().err,
        run_in_process(repair, f"--root={root}"),
        run_in_process(attach_audio, *data, *heard, "--files=x/{episode}.wav", "--microphone=left"),
        run_in_process(attach_spectrogram, *data, *heard),
        run_in_process(train, *TINY, *data, f"--output_dir={out}"),
    ]
    for one in told:
        assert str(one).startswith("error: ")
        assert f"fps is {fps!r}; wanted" in one
    assert not out.exists()


_MAKES = """
import os, sys
from dataclasses import dataclass
from lerobot.configs import parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

@dataclass
class Config:
    env: EnvConfig

@parser.wrap()
def main(cfg: Config):
    print("made", cfg.env.type)

sys.stderr = sys.stdout
register_third_party_plugins()  # as all of LeRobot's commands begin
for name in sys.argv[1:]:
    os.environ["MUJOCO_GL"] = name
    sys.argv[1:] = ["--env.type=playbyear"]
    try:
        main()
    except SystemExit:
        print("end of", name)
"""


@pytest.mark.slow
def test_a_way_to_draw_that_is_not_there_is_named_by_whoever_makes_an_environment():
    """In a process of its own: MuJoCo looks at the variable once, while it is imported."""
    names = ["elg", "EGL2", *(["osmesa"] if ctypes.util.find_library("OSMesa") is None else [])]
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    told = python(_MAKES, *names, environment=environment)
    for name in names:
        said, _, told = told.partition(f"end of {name}\n")
        assert f"MUJOCO_GL='{name}'" in said.strip().splitlines()[-1]
        assert "Set MUJOCO_GL=egl" in said.strip().splitlines()[-1]
