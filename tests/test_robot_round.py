"""The pages' commands for a robot with a microphone, LeRobot's own among them, one after the other as they stand there.

Only the options of the robot and its leader are replaced, and the microphone's device: the robot is the task's arm, simulated
in real time, and its sound goes through a sound server. An operator presses LeRobot's keys. Updates and seconds are few.
"""

import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from lerobot_operator import Corrections, Done, Episodes, Operator, Watches, run_command
from lerobot_robot_playbyear_sim.process import simulation
from sound_server import SoundServer, why_not
from support.pages import commands_of

ROOT = Path(__file__).parents[1]
RERUN_PORT = 9876  # LeRobot connects to it
CHECKPOINT = "checkpoints/last/pretrained_model"
SMALL = {"--preset": ["--preset=cpu", "--steps=4"], "--steps": 4, "--duration": 3, "--dataset.num_episodes": 2}

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(why_not()), reason=why_not())]


@dataclass(frozen=True)
class Robot:
    socket: str
    environment: dict[str, str]

    def in_place_of(self, cameras: dict[str, Any]) -> dict[str, Any]:
        """This robot with the microphones among another's cameras; it has a camera of its own."""
        heard = {name: {**camera, "device": "gripper"} for name, camera in cameras.items() if "device" in camera}
        assert all(camera["type"] == "microphone" for camera in heard.values())
        return {"type": "playbyear_sim", "socket": self.socket, "cameras": heard}

    def leader(self, demonstrates: bool) -> dict[str, Any]:
        return {"type": "playbyear_sim_leader", "socket": self.socket, "demonstrates": demonstrates}

    def run(self, words: Sequence[str]) -> Done:
        """Runs a command of a page."""
        given = dict(word.split("=", 1) for word in words if word.startswith(("--robot.", "--teleop.")))
        command = [word for word in words if word.partition("=")[0] not in given]
        if "--display_data=true" in command:
            if importlib.util.find_spec("rerun") is not None:
                with rerun_viewer():
                    return self.run_with_devices(words, command, given)
            command.remove("--display_data=true")  # needs lerobot[viz]
        return self.run_with_devices(words, command, given)

    def run_with_devices(self, words: Sequence[str], command: list[str], given: dict[str, str]) -> Done:
        devices = {}
        if "--robot.type" in given:
            devices["robot"] = self.in_place_of(yaml.safe_load(given.get("--robot.cameras", "{}")))
        if "--teleop.type" in given:
            devices["teleop"] = self.leader(demonstrates=words[0] != "lerobot-rollout")
        for device, options in devices.items():
            command += [f"--{device}.{name}={value}" for name, value in options.items()]
        done = run_command(command, self.operator(words), self.environment, timeout_s=1800, patience_s=600)
        assert done.status == 0, f"{' '.join(command)}\n{done.output[-3000:]}"
        return done

    def operator(self, words: Sequence[str]) -> Operator:
        if words[0] == "lerobot-record":
            return Episodes(self.socket, range(20), re_record=True)
        if "--strategy.type=dagger" in words or words[0] == "bash":
            return Corrections(self.socket, range(100, 102))
        return Watches(self.socket, ends_after_s=3 if words[0] == "lerobot-teleoperate" else None)


@contextmanager
def rerun_viewer() -> Iterator[None]:
    """What takes Rerun's data in place of its window; where nothing takes them, LeRobot's control loop stops."""
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "shown.rrd"
        command = [sys.executable, "-m", "rerun_cli", "--serve-grpc", f"--port={RERUN_PORT}", f"--save={saved}"]
        viewer = subprocess.Popen(command, start_new_session=True)  # it starts a program of its own
        try:
            wait_until(rerun_listens)
            yield
            shown = (b"observation.front", b"observation.gripper")
            wait_until(lambda: all(name in saved.read_bytes() for name in shown))
        finally:
            os.killpg(viewer.pid, signal.SIGKILL)
            viewer.wait()


def rerun_listens() -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", RERUN_PORT)) == 0


def wait_until(condition: Callable[[], bool], timeout_s: float = 60) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Iterator[Robot]:
    home = tmp_path_factory.mktemp("home")
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # a socket's path is short
        server = SoundServer(Path(folder), {"gripper": 1}, 16000)
        server.start()
        try:
            with simulation(Path(folder), server.fifo("gripper")) as socket:
                programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
                own = {"PATH": programs, "HF_LEROBOT_HOME": str(home), "OMP_NUM_THREADS": "1"}
                yield Robot(socket, {**os.environ, **server.environment, **own})
        finally:
            server.kill()


def commands(page: str, replacements: dict[str, Any] | None = None) -> list[list[str]]:
    return [words for words in commands_of(ROOT / "docs" / page, replacements) if words[0] != "pip"]


@pytest.fixture(scope="module")
def walked(robot, tmp_path_factory) -> Iterator[list[tuple[list[str], Done]]]:
    """The tutorial, and what its commands said; the current folder is its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("tutorial"))
        Path("examples").symlink_to(ROOT / "examples")
        yield [(words, robot.run(words)) for words in commands("tutorials/so101.md", SMALL)]


def features(dataset: str) -> dict[str, Any]:
    return json.loads((Path("outputs") / dataset / "meta/info.json").read_text())["features"]


def test_the_tutorial_goes_from_a_microphone_to_a_corrected_policy(walked):
    assert features("find_cube_with_sound")["observation.audio.gripper"]["shape"] == [800]
    corrected = features("corrections_with_sound")
    assert {"observation.audio.gripper", "intervention"} <= corrected.keys()
    assert "is_first" in corrected  # a takeover's pause is not in the recording
    assert Path("outputs/dagger", CHECKPOINT, "model.safetensors").is_file()
    (corrections,) = [done for words, done in walked if "--strategy.type=dagger" in words]
    assert sum(outcome.takeovers for outcome in corrections.outcomes) >= 1


def test_a_round_of_corrections_as_the_example_has_it(robot, walked, monkeypatch):
    """With one file for the robot, as `examples/so101.yaml`."""
    file = yaml.safe_load((ROOT / "examples/so101.yaml").read_text())
    file = {"robot": robot.in_place_of(file["robot"]["cameras"]), "teleop": robot.leader(demonstrates=False)}
    Path("robot.yaml").write_text(yaml.safe_dump(file))
    given = {
        "ROBOT": "robot.yaml",
        "POLICY": f"outputs/find_cube_policy/{CHECKPOINT}",
        "DEMOS": "outputs/find_cube_with_sound",
    }
    for name, value in {**given, "STEPS": "3", "ACT_S": "3"}.items():
        monkeypatch.setitem(robot.environment, name, value)
    robot.run(["bash", str(ROOT / "examples/corrections.sh"), "outputs/round"])
    assert Path("outputs/round/dagger", CHECKPOINT, "model.safetensors").is_file()


def test_other_policies_hear_as_their_page_says(robot, walked):
    """In the simulation and, with the tutorial's recording, on the robot."""
    few = {"--steps": 2, "--duration": 3, "--dataset.num_episodes": 2, "--eval.n_episodes": 1, "--eval.batch_size": 1}
    for words in commands("how_to/other_policies.md", few):
        robot.run(words)
    for run in ("act", "act_robot"):
        seen = json.loads(Path("outputs", run, CHECKPOINT, "config.json").read_text())["input_features"]
        assert {"observation.images.front", "observation.images.gripper"} <= seen.keys()


def test_demonstrations_of_failed_scenes_are_added_as_the_page_has_it(robot, walked):
    page = commands("tutorials/improve.md", {"--steps": 4, "--dataset.num_episodes": 1})
    for words in page[[words[0] for words in page].index("lerobot-record") :]:
        robot.run(words)
    (folder,) = [word.partition("=")[2] for word in words if word.startswith("--output_dir=")]
    assert Path(folder, CHECKPOINT, "model.safetensors").is_file()


def test_the_page_on_corrections_has_the_tutorials_commands_for_a_robot():
    tutorial, page = (
        {frozenset(words) for words in commands(name)} for name in ("tutorials/so101.md", "how_to/correct.md")
    )
    for_robots = {words for words in page if any(word.startswith("--robot.") for word in words)}
    assert for_robots
    assert for_robots <= tutorial
