"""One file is a whole robot with its microphone, for each of LeRobot's commands that acts on it."""

import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import parser
from lerobot.robots import RobotConfig
from lerobot.rollout.configs import DAggerStrategyConfig, RolloutConfig
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.teleoperators import TeleoperatorConfig
from support.shared import trained

from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig
from lerobot_playbyear.scripts.command import for_robots

FILE = Path(__file__).parents[1] / "examples" / "so101.yaml"
DATA = ("--dataset.repo_id=me/demos", "--dataset.root=here/demos", "--dataset.single_task=Find the cube")
PUT_OFF = "--strategy.upload_every_n_episodes=1000000"
CORRECTING = ("--strategy.type=dagger", "--strategy.record_autonomous=true", *DATA)


def parsed(kind: type, *options: str) -> Any:
    """What LeRobot's parser makes of a command line."""

    def options_of(cfg: kind) -> Any:
        return cfg

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot", *options])
        return parser.wrap()(options_of)()


@pytest.mark.parametrize(
    ("kind", "options"),
    [(RecordConfig, DATA), (RolloutConfig, ()), (RolloutConfig, CORRECTING)],
    ids=["lerobot-record", "lerobot-rollout", "lerobot-rollout with corrections"],
)
def test_one_file_is_the_robot_of_every_command(kind, options, monkeypatch, tmp_path):
    """From any folder, and an option on the command line wins over it."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "my robot.yaml"
    file.write_text(FILE.read_text())
    policy = (f"--policy.path={trained()}",) if kind is RolloutConfig else ()
    cfg = parsed(kind, "--config_path=my robot.yaml", *policy, *options, "--robot.port=/dev/ttyUSB7")
    assert isinstance(cfg.robot, RobotConfig.get_choice_class("so101_follower"))
    assert isinstance(cfg.teleop, TeleoperatorConfig.get_choice_class("so101_leader"))
    assert (cfg.robot.port, cfg.robot.id) == ("/dev/ttyUSB7", "follower")
    assert (cfg.teleop.port, cfg.teleop.id) == ("/dev/ttyACM1", "leader")
    assert cfg.robot.cameras["front"].index_or_path == 0
    microphone = cfg.robot.cameras["gripper"]
    assert isinstance(microphone, MicrophoneCameraConfig)
    assert microphone.device == "USB Audio"
    if options:
        assert (cfg.dataset.root, cfg.dataset.single_task) == ("here/demos", "Find the cube")
    assert not options or kind is RecordConfig or isinstance(cfg.strategy, DAggerStrategyConfig)


def test_no_command_of_ours_lets_lerobot_upload_what_was_not_to_be_pushed():
    """LeRobot's dagger uploads every few episodes, whatever `push_to_hub` says; each of its commands puts that off."""
    hint = for_robots("playbyear-dagger", ["--robot.type=so101_follower"]) or ""
    root = FILE.parents[1]
    pages = [
        path.read_text()
        for kind in ("docs/how_to/*.md", "docs/tutorials/*.md", "examples/*.sh")
        for path in root.glob(kind)
    ]
    lines = [line for text in (hint, *pages) for line in text.replace("\\\n", " ").splitlines()]
    commands = [line.split() for line in lines if line.startswith("lerobot-rollout --strategy.type=dagger")]
    assert len(commands) == 4
    for words in commands:
        # Without record_autonomous it uploads when Enter is pressed.
        assert {"--strategy.record_autonomous=true", PUT_OFF, "--dataset.push_to_hub=false"} <= set(words)
    cfg = parsed(RolloutConfig, f"--policy.path={trained()}", f"--config_path={FILE}", *CORRECTING, PUT_OFF)
    assert cfg.strategy.upload_every_n_episodes == 10**6


def test_the_page_shows_the_file():
    page = (FILE.parents[1] / "docs/how_to/microphones.md").read_text()
    assert FILE.read_text().partition("\nrobot:")[2] in page
