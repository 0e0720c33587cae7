"""Every command answers at once what needs no LeRobot: its help, a misspelt option, a dataset that is not there."""

import contextlib
import importlib
import json
import re
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import draccus
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from draccus.argparsing import ArgumentParser
from draccus.utils import DraccusException
from test_independence import run_without

from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.scripts.command import OPTIONS_FILE, find_mistake

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
from list_options import CONFIGS, as_text, list_options

LISTED = json.loads(OPTIONS_FILE.read_text())
listed_lerobot = pytest.mark.skipif(
    metadata.version("lerobot") != LISTED["lerobot"], reason="options are listed for another LeRobot"
)
HEAVY = {
    "torch",
    "torchvision",
    "torchaudio",
    "lerobot",
    "datasets",
    "pandas",
    "gymnasium",
    "gym_playbyear",
    "lerobot_env_playbyear",
}
_CALL = """
import importlib, sys
sys.argv = ["command", *{arguments!r}]
try:
    importlib.import_module("lerobot_playbyear.scripts.{name}").main()
except SystemExit as end:
    print("exit:", end.code)
"""


def module_of(command: str) -> str:
    return command.removeprefix("playbyear-").replace("-", "_")


def answer(command: str, *arguments: str) -> str:
    """What a command says where neither LeRobot nor torch can be imported."""
    return run_without(HEAVY, _CALL.format(arguments=arguments, name=module_of(command)))


def short_help(command: str) -> str:
    return importlib.import_module(f"lerobot_playbyear.scripts.{module_of(command)}").__doc__ or ""


def mistake(command: str, *arguments: str) -> str | None:
    return find_mistake(list(arguments), LISTED[command], LISTED["policies"])


@listed_lerobot
@pytest.mark.parametrize("command", CONFIGS)
def test_help_and_a_misspelt_option_need_neither_lerobot_nor_torch(command):
    said = answer(command, "--help")
    assert said.startswith(command)
    assert "exit: 0" in said
    assert "exit: 2" in answer(command, "--misspelt=1")


@pytest.mark.parametrize(
    ("command", "options", "said"),
    [
        ("playbyear-inspect", ("--dataset.repo_id=a/b", "--dataset.root={root}"), "exit: 2"),
        ("playbyear-push", ("--dataset.repo_id=a/b", "--dataset.root={root}"), "exit: error: Not pushed. "),
        (
            "playbyear-attach-audio",
            (
                "--dataset.repo_id=a/b",
                "--dataset.root={root}",
                "--output.repo_id=a/c",
                "--output.root={root}/c",
                "--files=x",
            ),
            "exit: error: ",
        ),
    ],
)
def test_the_files_of_a_dataset_are_looked_at_before_lerobot_is_imported(command, options, said, tmp_path):
    """One is not there, the other names files outside its folder."""
    stranger = tmp_path / "stranger"
    for folder in ("meta", "data/chunk-000"):
        (stranger / folder).mkdir(parents=True)
    pq.write_table(pa.table({"index": [0]}), stranger / "data/chunk-000/file-000.parquet")
    (stranger / "meta/info.json").write_text('{"features": {}, "data_path": "../{chunk_index}/{file_index}"}')
    for root in (stranger, tmp_path / "nowhere"):
        assert said in answer(command, *(option.format(root=root) for option in options))


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("playbyear-repair", "--root=/no/such/folder", "exit: error: /no/such/folder holds no LeRobotDataset"),
        ("playbyear-train", "--preset=tpu", "exit: error: --preset=tpu is not known"),
    ],
)
def test_what_can_be_told_from_an_option_alone_is_told_at_once(command, option, said):
    assert said in answer(command, option, *(["--dataset.repo_id=a/b"] if command == "playbyear-train" else []))


@pytest.mark.parametrize("command", CONFIGS)
def test_the_short_help_fits_two_screens_and_tells_the_truth(command):
    lines = short_help(command).splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 100
    policy = {f"policy.{name}": value for name, value in _defaults(PlaybyearConfig).items()}
    defaults = _defaults(CONFIGS[command]) | (policy if "policy" in LISTED[command]["open"] else {})
    named = re.findall(r"^  --([\w.]+)=(\S+) ", short_help(command), re.MULTILINE)
    assert named
    for name, default in named:
        if name == "policy.path" and name not in defaults:
            continue  # LeRobot's, for any field that a checkpoint can fill
        name = "store.place" if name == "store" else name  # its short form
        assert name in defaults, name
        assert default in ("...", defaults[name]), name
    assert {name for name, _ in named} >= set(LISTED[command]["required"])


def _defaults(config: type) -> dict[str, str]:
    """The default of every option, as it would be typed."""
    actions = ArgumentParser(config).parser._actions
    values = {option[2:]: action.default for action in actions for option in action.option_strings}
    return {
        name: json.dumps(value) if value is None or isinstance(value, bool | int | float) else str(value)
        for name, value in values.items()
    }


@listed_lerobot
def test_the_list_of_options_is_that_of_the_parsers():
    assert OPTIONS_FILE.read_text() == as_text(list_options()), "run `python tools/list_options.py`"


DATA = "--dataset.repo_id=a/b"


@pytest.mark.parametrize(
    ("command", "options", "said"),
    [
        ("playbyear-train", (DATA, "--bach_size=3"), "--bach_size is no option; did you mean --batch_size?"),
        ("playbyear-train", (DATA, "--datset.root=x"), "did you mean --dataset.root?"),
        (
            "playbyear-train",
            (DATA, "--policy.type=playbyear", "--policy.image_sise=3"),
            "did you mean --policy.image_size?",
        ),
        ("playbyear-train", (DATA, "--steps=many"), "--steps=many: wanted a whole number."),
        ("playbyear-train", (DATA, "--dataset.eval_split=long"), "wanted a number."),
        ("playbyear-train", (DATA, "--resume=perhaps"), "wanted true or false."),
        ("playbyear-train", (DATA, "--steps"), "--steps needs a value"),
        ("playbyear-train", (DATA, "cpu"), "'cpu' is no option"),
        ("playbyear-train", (), "--dataset.repo_id is needed."),
        ("playbyear-record", (DATA,), "--env.type is needed."),
        ("playbyear-repair", ("--root=x", "--dry-run=true"), "did you mean --dry_run?"),
    ],
)
def test_what_is_refused_at_once_the_full_parser_would_refuse_too(command, options, said):
    assert said in str(mistake(command, *options))
    with pytest.raises((SystemExit, DraccusException, TypeError)):
        draccus.parse(CONFIGS[command], args=list(options))


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("playbyear-train", (DATA, "--policy.type=act", "--policy.chunk_size=3")),
        ("playbyear-train", (DATA, "--policy.type=of_a_plugin", "--policy.own_option=3")),
        ("playbyear-train", (DATA, "--policy.path=me/act", "--policy.chunk_size=3", "--preset=cpu")),
        ("playbyear-train", (DATA, "--env.type=own", "--env.discover_packages_path=mine", "--env.own=1")),
        ("playbyear-train", (DATA, "--steps", "3", "--seed=-1", "--dataset.eval_split=.5", "--log_freq=1_000")),
        ("playbyear-train", ("--config_path=x.json", "--resume=true", "--policy.anything=1")),
        ("playbyear-train", ("--dataset=dataset.yaml", "--seed=null")),
        ("playbyear-dagger", ("--resume=true", "--output_dir=x")),
        ("playbyear-record", (DATA, "--env.type=playbyear", "--expert.type=own", "--expert.own=x")),
        ("playbyear-video", ("--env.type=own", "--policy.path=x", "--policy.device=cpu", "--seed", "-3")),
    ],
)
def test_what_may_be_right_is_left_to_the_full_parser(command, options):
    assert mistake(command, *options) is None


@dataclass
class Values:
    """One option of each kind that is checked before the full parser."""

    resume: bool = False
    steps: int = 0
    eval_split: float = 0.0


_ODD_VALUES = [
    *("1", "0", "y", "n", "yes", "No", "on", "OFF", "True", "t", "'true'", '"no"', "null", "~", "None"),
    *("1_000", "0x1F", "0o17", "1e3", "1.0", "-3", ".5", "5.", "+2", "'3'", "1:30"),
    *("inf", "-inf", ".inf", ".NaN", "Infinity"),
]


@pytest.mark.parametrize(
    ("name", "option"), [("resume", "resume"), ("steps", "steps"), ("eval_split", "dataset.eval_split")]
)
def test_no_value_that_the_full_parser_takes_is_refused(name, option):
    taken = []
    for value in _ODD_VALUES:
        with contextlib.suppress(SystemExit, DraccusException):
            draccus.parse(Values, args=[f"--{name}={value}"])
            taken.append(value)
    assert len(taken) > 5
    assert not [value for value in taken if mistake("playbyear-train", DATA, f"--{option}={value}")]


@listed_lerobot
def test_another_version_of_lerobot_may_have_other_options(monkeypatch, capsys):
    from lerobot_playbyear.scripts import command

    monkeypatch.setattr(sys, "argv", ["playbyear-train", "--option_of_the_next_version=1"])
    with pytest.raises(SystemExit):
        command.answer_at_once("playbyear-train", "")
    monkeypatch.setattr(command.metadata, "version", lambda name: "0.6.99")
    command.answer_at_once("playbyear-train", "")


@pytest.mark.parametrize(
    ("command", "option"), [("inspect", "--picture_height"), ("train", "--dataset.image_transforms")]
)
def test_all_options_are_a_word_away(command, option, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [f"playbyear-{command}", "--help=all"])
    with pytest.raises(SystemExit):
        importlib.import_module(f"lerobot_playbyear.scripts.{command}").main()
    assert option in capsys.readouterr().out


def test_names_of_files_are_lerobots():
    from lerobot.datasets import utils
    from lerobot.utils import constants

    from lerobot_playbyear.datasets import files

    ours = {name: value for name, value in vars(files).items() if name.isupper() and name != "HF_HOME"}
    assert ours == {name: getattr(constants if "HOME" in name else utils, name) for name in ours}
