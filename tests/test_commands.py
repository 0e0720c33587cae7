"""Every command answers at once what needs no LeRobot: its help, a misspelt option, a dataset that is not there."""

import json
import os
import re
import subprocess
import sys
from importlib import metadata
from itertools import batched
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from draccus.argparsing import ArgumentParser
from support.commands import run_without

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.scripts import command as command_module
from lerobot_playbyear.scripts.command import OPTIONS_FILE, find_mistake, short_help

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
from list_options import CONFIGS, as_text, list_options
from options_page import PAGE, as_page

LISTED = json.loads(OPTIONS_FILE.read_text())
listed_lerobot = pytest.mark.skipif(
    metadata.version("lerobot") != LISTED["lerobot"], reason="options are listed for another LeRobot"
)
HEAVY = {"torch", "torchvision", "torchaudio", "lerobot", "datasets", "pandas", "gymnasium", "gym_playbyear"}
DATA = "--dataset.repo_id=a/b"
_CALLS = """
import contextlib, io, json, sys
from lerobot_playbyear.scripts import commands
answers = []
for name, *arguments in json.loads({calls!r}):
    sys.argv = ["command", *arguments]
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(said):
        try:
            getattr(commands, name)()
        except SystemExit as end:
            print("exit:", end.code)
    answers.append(said.getvalue())
print(json.dumps(answers))
"""


def answers(*calls: tuple[str, ...]) -> list[str]:
    """What commands say where neither LeRobot nor torch can be imported."""
    called = json.dumps(
        [(command.removeprefix("playbyear-").replace("-", "_"), *options) for command, *options in calls]
    )
    return json.loads(run_without({*HEAVY, "lerobot_env_playbyear"}, _CALLS.format(calls=called)))


def mistake(command: str, *arguments: str) -> str | None:
    return find_mistake(list(arguments), LISTED[command], LISTED["policies"])


@listed_lerobot
def test_help_and_a_misspelt_option_need_neither_lerobot_nor_torch():
    said = answers(*((command, option) for command in CONFIGS for option in ("--help", "--misspelt=1")))
    for command, (helps, refuses) in zip(CONFIGS, batched(said, 2), strict=True):
        assert helps.startswith(command)
        assert "exit: 0" in helps
        assert "exit: 2" in refuses


def test_help_may_be_read_to_its_beginning_only():
    """As `head` does."""
    read, write = os.pipe()
    os.close(read)
    program = "import sys; sys.argv[1:] = ['--help']; from lerobot_playbyear.scripts import commands; commands.train()"
    done = subprocess.run([sys.executable, "-c", program], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_can_be_told_from_options_and_files_is_told_before_lerobot_is_imported(tmp_path):
    """A dataset that is not there, and one that names files outside its folder."""
    stranger = tmp_path / "stranger"
    for folder in ("meta", "data/chunk-000"):
        (stranger / folder).mkdir(parents=True)
    pq.write_table(pa.table({"index": [0]}), stranger / "data/chunk-000/file-000.parquet")
    (stranger / "meta/info.json").write_text('{"features": {}, "data_path": "../{chunk_index}/{file_index}"}')
    output = ("--output.repo_id=a/c", f"--output.root={tmp_path / 'c'}", "--files=x")
    calls = [("playbyear-repair", "--root=/no/such"), ("playbyear-train", DATA, "--preset=tpu")]
    for root in (f"--dataset.root={stranger}", f"--dataset.root={tmp_path / 'nowhere'}"):
        calls += [("playbyear-inspect", DATA, root), ("playbyear-push", DATA, root)]
        calls.append(("playbyear-attach-audio", DATA, root, *output))
    repair, train, *of_datasets = answers(*calls)
    assert "There is no LeRobotDataset in '/no/such': it does not exist" in repair
    assert "exit: error: --preset=tpu is not known" in train
    for inspect, push, attach in batched(of_datasets, 3):
        assert "exit: 2" in inspect
        assert "exit: error: Not pushed. " in push
        assert "exit: error: " in attach


@pytest.mark.parametrize("command", CONFIGS)
def test_the_short_help_fits_two_screens_and_tells_the_truth(command):
    text = short_help(command)
    assert len(text.splitlines()) <= 80
    assert max(map(len, text.splitlines())) <= 100
    policy = {f"policy.{name}": value for name, value in _defaults(PlaybyearConfig).items()}
    defaults = _defaults(CONFIGS[command]) | (policy if "policy" in LISTED[command]["open"] else {})
    named = re.findall(r"^  --([\w.]+)=(\S+) ", text, re.MULTILINE)
    assert {name for name, _ in named} >= set(LISTED[command]["required"])
    for name, default in named:
        if name == "policy.path" and name not in defaults:
            continue  # LeRobot's, for any field that a checkpoint can fill
        name = "store.place" if name == "store" else name  # its short form
        assert name in defaults, name
        assert default in ("...", defaults[name]), name


def _defaults(config: type) -> dict[str, str]:
    """The default of every option, as it would be typed."""
    actions = ArgumentParser(config).parser._actions
    values = {option[2:]: action.default for action in actions for option in action.option_strings}
    return {
        name: json.dumps(value) if value is None or isinstance(value, bool | int | float) else str(value)
        for name, value in values.items()
    }


@listed_lerobot
def test_the_list_and_the_page_of_options_are_those_of_the_parsers():
    listed = list_options()
    assert OPTIONS_FILE.read_text() == as_text(listed), "run `python tools/list_options.py`"
    assert PAGE.read_text() == as_page(CONFIGS, listed), "run `python tools/list_options.py`"


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("playbyear-train", (DATA, "--policy.type=of_a_plugin", "--policy.own_option=3")),
        ("playbyear-train", (DATA, "--policy.path=me/act", "--policy.chunk_size=3", "--preset=cpu")),
        ("playbyear-train", (DATA, "--env.type=own", "--env.discover_packages_path=mine", "--env.own=1")),
        ("playbyear-train", (DATA, "--steps", "3", "--seed=-1", "--dataset.eval_split=.5", "--log_freq=1_000")),
        ("playbyear-train", ("--config_path=x.json", "--resume=true", "--policy.anything=1")),
        ("playbyear-train", ("--dataset=dataset.yaml", "--seed=null")),
        ("playbyear-record", (DATA, "--env.type=playbyear", "--expert.type=own", "--expert.own=x")),
        ("playbyear-video", ("--env.type=own", "--policy.path=x", "--policy.device=cpu", "--seed", "-3")),
    ],
)
def test_what_may_be_right_is_left_to_the_full_parser(command, options):
    assert mistake(command, *options) is None


@listed_lerobot
def test_another_version_of_lerobot_may_have_other_options(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["playbyear-train", "--option_of_the_next_version=1"])
    with pytest.raises(SystemExit):
        command_module.answer_at_once("playbyear-train")
    monkeypatch.setattr(command_module.metadata, "version", lambda name: "0.6.99")
    command_module.answer_at_once("playbyear-train")


def test_all_options_are_a_word_away(commands):
    assert "--dataset.image_transforms" in commands.succeed("playbyear-train", "--help=all").output


def test_names_of_files_are_lerobots():
    from lerobot.datasets import utils
    from lerobot.utils import constants

    from lerobot_playbyear.datasets import files

    lerobots = {**vars(utils), **vars(constants)}
    ours = {name: value for name, value in vars(files).items() if name.isupper() and name in lerobots}
    assert len(ours) >= 5
    assert ours == {name: lerobots[name] for name in ours}
