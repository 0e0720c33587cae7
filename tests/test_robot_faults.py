"""What can go wrong beside a robot: the arm holds within a tick, one message says why, and the next attempt goes on."""

import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robot_factory import ScriptedConsole, joint_config, noise_file, robot_env
from sound_server import Player, SoundServer, why_not

from lerobot_playbyear.microphones.config import FileMicrophoneConfig, PortAudioMicrophoneConfig
from lerobot_playbyear.microphones.microphone import MicrophoneError

TICK_S = 0.05
needs_server = pytest.mark.skipif(bool(why_not()), reason=why_not())


@contextmanager
def heard_through_a_server(console: Any = None, **changes: Any) -> Iterator[tuple[Any, SoundServer]]:
    """An arm that moves slowly, with a microphone on a real sound server."""
    microphones = {"gripper": PortAudioMicrophoneConfig(device="bench", sample_rate=16000)}
    config = joint_config(microphones=microphones, episode_s=10.0, **changes)
    with (
        tempfile.TemporaryDirectory(dir="/tmp") as folder,
        SoundServer(Path(folder), {"bench": 1}, 16000) as server,
        Player(server.fifo("bench"), 1, 16000),
        robot_env(config, console) as env,
    ):
        env.reset(seed=0)
        env.arm.robot.config.speed = 20.0  # units per second: a target of 10 takes half a second
        yield env, server


def until_it_ends(env: Any, most: int = 100) -> tuple[float, dict[str, Any]]:
    """Steps towards a far target until the attempt ends: when the last action was sent that moves the arm, and the info."""
    for _ in range(most):
        _, _, terminated, truncated, info = env.step(np.full(3, 10, np.float32))
        if terminated or truncated:
            assert truncated
            assert not terminated
            moving = [when for when, target in env.arm.robot.told if target[:2].max() > 9.9]
            return moving[-1], info
    raise AssertionError("it never ended")


def assert_it_holds(env: Any) -> None:
    """The last thing that the arm was told is to stay where it is."""
    target = env.arm.robot.told[-1][1]
    assert target[:2].max() < 9.9
    assert target[2] > 9.9  # the gripper goes on to squeeze
    place = env.arm.robot.place
    time.sleep(0.1)
    env.arm.robot.is_blind = False
    env.arm.robot.get_observation()
    np.testing.assert_allclose(env.arm.robot.place[:2], target[:2], atol=1e-6)
    assert np.abs(env.arm.robot.place - place)[:2].max() < 1.5 * 20 * TICK_S  # at most back to where it was last seen


def errors_of(caplog: Any) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


@needs_server
def test_the_sound_server_dies(caplog):
    with heard_through_a_server(max_step=None, max_relative_target=None) as (env, server):
        env.step(np.full(3, 10, np.float32))
        server.kill()
        killed = time.perf_counter()
        last, info = until_it_ends(env)
        assert (
            last - killed < 2.5 * TICK_S
        )  # noticed at the first tick that follows, or, at the border of two, the second
        assert_it_holds(env)
        assert (info["is_success"], info["verdict"]) == (False, "discard")
        assert len(errors_of(caplog)) == 1
        assert "The microphone gripper is gone" in errors_of(caplog)[0]
        with pytest.raises(MicrophoneError):
            env.reset(seed=1)
        server.start()
        observation, _ = env.reset(seed=1)
        observation = env.step(np.zeros(3, np.float32))[0]
        assert np.abs(observation["audio.gripper"]).max() > 0


@needs_server
def test_the_microphone_is_pulled_out_and_only_zeros_come(caplog):
    with heard_through_a_server(silent_s=0.4, max_step=None, max_relative_target=None) as (env, server):
        server.remove("bench")
        until_it_ends(env)
        assert_it_holds(env)
        assert len(errors_of(caplog)) == 1
        assert "The microphone gripper" in errors_of(caplog)[0]
        server.add("bench")
        for seed in (1, 2):  # a busy machine may stand still once, which ends an attempt, too
            env.reset(seed=seed)
            if not env.step(np.zeros(3, np.float32))[3]:
                break
        else:
            pytest.fail(f"No attempt goes on: {errors_of(caplog)}")


@needs_server
def test_the_process_is_stopped_for_two_seconds(caplog):
    with heard_through_a_server(max_step=None, max_relative_target=None) as (env, _):
        script = f"sleep 0.2; kill -STOP {os.getpid()}; sleep 2; kill -CONT {os.getpid()}"
        for _ in range(3):
            env.step(np.full(3, 1, np.float32))
        with subprocess.Popen(["sh", "-c", script]):
            _, info = until_it_ends(env)
        assert "stood still" in " ".join(errors_of(caplog))
        assert len(errors_of(caplog)) == 1
        assert info["verdict"] == "discard"
        time.sleep(1.0)  # until the sound that was lost is known to be, before the next attempt
        env.reset(seed=1)
        blocks = [env.step(np.zeros(3, np.float32))[0]["audio.gripper"] for _ in range(10)]
        assert all(np.abs(block).max() > 0 for block in blocks[1:])
        assert env.episode_facts()["drop_outs"] == {"gripper": []}


def test_a_clock_that_is_fast_costs_no_attempt(tmp_path):
    wav = noise_file(tmp_path, 16000)
    microphones = {"gripper": FileMicrophoneConfig(path=str(wav), sample_rate=16000, speed=1.005)}
    with robot_env(joint_config(microphones=microphones, episode_s=6.0)) as env:
        env.reset(seed=0)
        steps = [env.step(np.zeros(3, np.float32)) for _ in range(100)]
        assert not any(step[3] for step in steps)
        assert env.n_drop_outs == 0


def test_a_camera_that_stops_makes_the_arm_hold(caplog):
    with robot_env(joint_config(episode_s=10.0, max_step=None, max_relative_target=None)) as env:
        env.reset(seed=0)
        env.arm.robot.config.speed = 20.0
        env.step(np.full(3, 10, np.float32))
        env.arm.robot.is_blind = True
        stopped = time.perf_counter()
        last, _ = until_it_ends(env)
        assert last - stopped < 2.5 * TICK_S
        assert_it_holds(env)
        assert len(errors_of(caplog)) == 1


def test_a_person_may_keep_an_attempt_that_ended_with_a_fault():
    def press(status):
        if "Set the scene" in status.note:
            return "p"
        return "s" if "not finite" in status.note else None

    with robot_env(joint_config(), ScriptedConsole(press)) as env:
        env.reset(seed=0)
        env.step(np.zeros(3, np.float32))
        _, _, terminated, truncated, info = env.step(np.full(3, np.nan))
    assert (terminated, truncated) == (False, True)
    assert (info["is_success"], info["verdict"], info["was_stopped"]) == (True, "success", True)


ENDLESS = """
import signal
import sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it, and its children do
sys.path.insert(0, {tests!r})
import numpy as np
from robot_factory import joint_config
from lerobot_playbyear.robots.env import RobotEnv

env = RobotEnv(joint_config(episode_s=60.0, max_step=None, max_relative_target=None))
env.reset(seed=0)
robot = env.arm.robot
robot.config.speed = 1.0  # units per second
try:
    print("moving", flush=True)
    while True:
        env.step(np.full(3, 10, np.float32))
finally:
    env.close()
    print(robot.told[-1][1][:2].max() < 9.9, robot.is_connected, flush=True)
"""


def test_interrupting_the_program_makes_the_arm_hold_and_lets_go():
    code = ENDLESS.format(tests=str(Path(__file__).parent))
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout is not None
    try:
        assert child.stdout.readline().strip() == "moving"
        time.sleep(0.3)
        child.send_signal(signal.SIGINT)
        told, errors = child.communicate(timeout=60)
    finally:
        child.kill()
    assert told.strip() == "True False", errors


class Bus:
    """Motors behind a port, as LeRobot closes them: first it takes the torque off, which a port that is gone refuses."""

    def __init__(self) -> None:
        self.is_open = self.is_gone = False
        self.closed_by_force = 0

    def connect(self) -> None:
        if self.is_gone:
            raise ConnectionError("no such port")
        self.is_open = True

    def disconnect(self, disable_torque: bool = True) -> None:
        if disable_torque and self.is_gone:
            raise ConnectionError("there is no status packet")
        self.closed_by_force += not disable_torque
        self.is_open = False


def through_a_bus(device: Any, monkeypatch: Any) -> Bus:
    """Lets a device be as connected as its motors are."""
    bus = device.bus = Bus()
    bus.is_open = True
    answer = device.get_observation if hasattr(device, "get_observation") else device.get_action

    def answers() -> Any:
        if bus.is_gone or not bus.is_open:
            raise ConnectionError("there is no status packet")
        return answer()

    name = answer.__name__
    monkeypatch.setattr(device, name, answers)
    monkeypatch.setattr(type(device), "is_connected", property(lambda self: self.bus.is_open))
    monkeypatch.setattr(type(device), "connect", lambda self, calibrate=True: self.bus.connect())
    monkeypatch.setattr(type(device), "disconnect", lambda self: self.bus.disconnect())
    return bus


def test_an_arm_whose_cable_was_pulled_is_connected_again(monkeypatch):
    asked: list[str] = []

    def press(status: Any) -> str | None:
        if "P tries again" in status.note:
            asked.append(status.note)
            bus.is_gone = len(asked) < 2  # it is plugged in before the second press
            return "p"
        return "p" if "Set the scene" in status.note else "r" if "throws the attempt away" in status.note else None

    with robot_env(joint_config(), ScriptedConsole(press)) as env:
        bus = through_a_bus(env.arm.robot, monkeypatch)
        env.reset(seed=0)
        bus.is_gone = True
        assert env.step(np.zeros(3, np.float32))[3]
        env.reset(seed=1)
        assert not env.step(np.zeros(3, np.float32))[3]
        assert len(asked) == 2
        assert bus.closed_by_force


def test_an_arm_is_not_let_go_of_where_a_microphone_cannot_be_opened(tmp_path, monkeypatch):
    asked: list[str] = []
    wav = tmp_path / "noise.wav"  # it is not there yet

    def press(status: Any) -> str | None:
        if "P tries again" in status.note:
            asked.append(status.note)
            if len(asked) == 2:
                noise_file(tmp_path, 16000)
            return "p"
        return "p" if "Set the scene" in status.note else None

    with robot_env(joint_config(wav), ScriptedConsole(press)) as env:
        let_go: list[bool] = []
        disconnect = env.arm.disconnect
        monkeypatch.setattr(env.arm, "disconnect", lambda: (let_go.append(True), disconnect()))
        env.reset(seed=0)
        assert not let_go
        assert len(asked) == 2
        assert not any("Hold the arm" in note for note in asked)


def test_a_leader_whose_cable_was_pulled_is_connected_again(monkeypatch):
    from lerobot_robot_playbyear_sim import JointLeaderConfig
    from test_robot_env import acting, teleop

    from lerobot_playbyear.episodes.play import play

    asked: list[str] = []

    def press(status: Any) -> str | None:
        if "P tries again" in status.note:
            asked.append(status.note)
            bus.is_gone = len(asked) < 2
            return "p"
        return "p" if "Set the scene" in status.note else "r" if "throws the attempt away" in status.note else None

    def pulls(n: int) -> None:
        bus.is_gone |= n == 3

    with robot_env(joint_config(episode_s=0.5), ScriptedConsole(press)) as env:
        expert, leader = teleop(env, JointLeaderConfig())
        bus = through_a_bus(leader, monkeypatch)
        assert len(play(env, acting(pulls), seed=0, expert=expert)) < 10
        assert len(play(env, acting(lambda n: None), seed=1, expert=expert)) == 10
        assert len(asked) == 2
        assert "Look at its cable" in asked[0]
        bus.is_gone = True
        expert.close()  # says nothing
        assert bus.closed_by_force


def test_a_leader_that_fails_while_the_arms_meet_is_asked_about(monkeypatch):
    from lerobot_robot_playbyear_sim import JointLeaderConfig
    from test_robot_env import acting, teleop

    from lerobot_playbyear.episodes.play import play

    console = ScriptedConsole(
        lambda s: "p" if "Set the scene" in s.note else "q" if "throws the attempt away" in s.note else None
    )
    with robot_env(joint_config(episode_s=2.0), console) as env:
        expert, leader = teleop(env, JointLeaderConfig(has_motors=True))

        def fails(feedback: Any) -> None:
            raise ConnectionError("there is no status packet")

        monkeypatch.setattr(leader, "send_feedback", fails)
        episode = play(env, acting(lambda n: console.press("space") if n == 3 else None), seed=0, expert=expert)
        expert.close()
    assert not episode.success
    assert len(episode) < 6
    assert any("The leader does not answer: there is no status packet" in note for note in console.notes)
