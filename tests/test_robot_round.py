"""A whole round on a robot with a microphone, by the commands of the pages; only the robot's options are replaced.

The robot is the task's arm, simulated in real time; its sound goes through a sound server. An operator presses LeRobot's keys.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from lerobot_operator import Corrections, Episodes, run_command
from lerobot_robot_playbyear_sim.process import simulation
from sound_server import SoundServer, why_not

ROOT = Path(__file__).parents[1]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(why_not()), reason=why_not())]


@dataclass(frozen=True)
class Robot:
    socket: str
    options: list[str]
    leader: list[str]
    file: dict
    environment: dict[str, str]


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Iterator[Robot]:
    home = tmp_path_factory.mktemp("home")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # a socket's path is short
        server = SoundServer(Path(folder), {"gripper": 1}, 16000)
        server.start()
        try:
            with simulation(Path(folder), server.fifo("gripper")) as socket:
                camera = "{gripper: {type: microphone, device: gripper}}"
                options = ["--robot.type=playbyear_sim", f"--robot.socket={socket}", f"--robot.cameras={camera}"]
                leader = ["--teleop.type=playbyear_sim_leader", f"--teleop.socket={socket}"]
                file = {"robot": {"type": "playbyear_sim", "socket": str(socket), "cameras": yaml.safe_load(camera)}}
                file["teleop"] = {"type": "playbyear_sim_leader", "socket": str(socket)}
                programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
                own = {"PATH": programs, "HF_LEROBOT_HOME": str(home), "OMP_NUM_THREADS": "1"}
                yield Robot(socket, options, leader, file, {**os.environ, **server.environment, **own})
        finally:
            server.kill()


@pytest.fixture(scope="module")
def heard(robot, tmp_path_factory) -> Path:
    """Two demonstrations with sound."""
    root = tmp_path_factory.mktemp("data") / "demos"
    command = [
        *("lerobot-record", *robot.options, *robot.leader, "--teleop.demonstrates=true", "--play_sounds=false"),
        *("--dataset.repo_id=me/demos", f"--dataset.root={root}", "--dataset.push_to_hub=false"),
        *("--dataset.single_task=Find the cube", "--dataset.num_episodes=2", "--dataset.fps=20"),
    ]  # with videos, LeRobot's default: the samples are in the session's file
    done = run_command(command, Episodes(robot.socket, range(20), re_record=True), robot.environment, timeout_s=300)
    assert done.status == 0, done.output[-2000:]
    attach = ["playbyear-attach-audio", "--dataset.repo_id=me/demos", f"--dataset.root={root}"]
    said = subprocess.run(attach, env=robot.environment, capture_output=True, text=True, check=True).stdout
    assert said.count("frames, exact samples of 0 from the pictures") == 2
    return root.with_name("demos_with_sound")


def test_a_round_of_corrections_as_the_example_has_it(robot, heard, tmp_path):
    train = [
        *("playbyear-train", "--preset=cpu", "--steps=4"),
        *("--save_freq=4", f"--dataset.root={heard}", "--dataset.repo_id=me/demos_with_sound"),
        *(f"--output_dir={tmp_path / 'train'}", "--wandb.enable=false", "--policy.device=cpu"),
    ]
    subprocess.run(train, env=robot.environment, check=True, capture_output=True)
    options = tmp_path / "robot.yaml"
    options.write_text(yaml.safe_dump(robot.file))
    given = {
        "ROBOT": str(options),
        "POLICY": str(tmp_path / "train/checkpoints/last/pretrained_model"),
        "DEMOS": str(heard),
        "STEPS": "3",
        "ACT_S": "3",
    }
    command = ["bash", str(ROOT / "examples/corrections.sh"), str(tmp_path / "round")]
    operator = Corrections(robot.socket, range(100, 102))
    done = run_command(command, operator, {**robot.environment, **given}, timeout_s=900)
    assert done.status == 0, done.output[-3000:]
    info = json.loads((tmp_path / "round/corrections_with_sound/meta/info.json").read_text())
    assert info["features"]["observation.audio.gripper"]["shape"] == [800]
    assert "is_first" in info["features"]  # a takeover's pause is not in the recording
    assert sum(outcome.takeovers for outcome in operator.outcomes) >= 1
    assert (tmp_path / "round/dagger/checkpoints/last/pretrained_model/model.safetensors").is_file()
