"""A robot as an environment: time, limits, faults, and the person beside it."""

import logging
import time
from types import SimpleNamespace

import numpy as np
import pytest
from robot_factory import ScriptedConsole, joint_config, noise_file, robot_env

from lerobot_playbyear.dagger import ExpertError
from lerobot_playbyear.episodes.environment import env_facts, env_spec
from lerobot_playbyear.episodes.episode import Verdict
from lerobot_playbyear.episodes.frames import dataset_features
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.robots import arm
from lerobot_playbyear.robots.parts import RobotError
from lerobot_playbyear.robots.ticks import Ticks
from lerobot_playbyear.teleoperation.controls import PersonLeftError

REST = np.zeros(3, np.float32)


@pytest.fixture
def wav(tmp_path):
    return noise_file(tmp_path, 16000)


def ten_steps(wav):
    """How long they took [s], what the environment says of them, and what was heard."""
    with robot_env(joint_config(wav)) as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        start, blocks = time.perf_counter(), []
        for _ in range(10):
            observation, _, terminated, truncated, info = env.step(REST)
            assert [terminated, truncated, info["is_success"]] == [False] * 3
            assert env.observation_space.contains(observation)
            blocks.append(observation["audio.gripper"])
        return time.perf_counter() - start, env.episode_facts(), blocks


def test_it_observes_what_robot_and_microphones_give_and_keeps_the_time(wav):
    for _ in range(3):  # a busy machine may stand still once
        passed, facts, blocks = ten_steps(wav)
        if facts["rate_hz"] > 19:
            break
    assert 0.45 < passed < 0.75
    assert facts["rate_hz"] == pytest.approx(20, rel=0.1)
    assert facts["ticks"] == 10
    assert facts["drop_outs"] == {"gripper": []}
    from lerobot_playbyear.datasets.audio_files import read_audio

    played, heard = read_audio(wav)[0][:, 0].astype(float), np.concatenate(blocks).astype(float)
    found = np.correlate(played, heard, "valid")
    assert found.max() > 0.99 * np.dot(heard, heard)  # the blocks join without a gap


def test_names_of_joints_reach_the_dataset(wav):
    config = joint_config(wav)
    env = env_spec(config).make()
    try:
        facts = env_facts(env)
    finally:
        env.close()
    features = dataset_features(facts)
    joints = ["shoulder.pos", "elbow.pos", "gripper.pos"]
    assert features["observation.state"]["names"] == features["action"]["names"] == joints
    assert features["observation.audio.gripper"]["shape"] == (800,)
    assert facts.fps == 20


def test_an_action_changes_by_no_more_than_the_limit(wav):
    with robot_env(joint_config(max_step=5.0, max_relative_target=None)) as env:
        env.reset(seed=0)
        env.step(REST)
        for _ in range(3):
            env.step(np.array([100, -100, 1], np.float32))
        targets = [target for _, target in env.arm.robot.told][-3:]
    np.testing.assert_allclose(targets, [[5, -5, 1], [10, -10, 1], [15, -15, 1]])


def test_the_limit_of_the_robot_itself_is_on_by_default():
    with robot_env(joint_config()) as env:
        assert env.arm.robot.config.max_relative_target == 20.0


@pytest.fixture
def made(monkeypatch):
    """The options that robots were made with; each is an arm of joints, whatever its options."""
    from lerobot_robot_playbyear_sim import JointArmConfig
    from lerobot_robot_playbyear_sim.joints import JointArm

    configs = []

    def make(config):
        configs.append(config)
        return JointArm(JointArmConfig())

    monkeypatch.setattr(arm, "make_robot_from_config", make)
    return configs


def test_each_arm_of_a_robot_with_two_has_the_limit(made, caplog):
    from lerobot.robots.bi_so_follower import BiSOFollowerConfig
    from lerobot.robots.so_follower import SOFollowerConfig

    left, right = SOFollowerConfig(port="x"), SOFollowerConfig(port="y", max_relative_target=5.0)
    arm.Arm(BiSOFollowerConfig(left_arm_config=left, right_arm_config=right), 20.0)
    assert (made[0].left_arm_config.max_relative_target, made[0].right_arm_config.max_relative_target) == (20.0, 5.0)
    assert left.max_relative_target is None
    assert not caplog.text


def test_a_robot_that_cannot_be_limited_so_is_named(made, caplog):
    from lerobot.robots.hope_jr import HopeJrHandConfig

    hand = HopeJrHandConfig(port="x", side="left")
    arm.Arm(hand, None)
    assert not caplog.text
    arm.Arm(hand, 20.0, max_step=2.0)
    assert (
        "--env.max_relative_target=20.0 does nothing: --env.robot.type=hope_jr_hand has no such option" in caplog.text
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_never_reaches_the_robot(value, caplog):
    with robot_env(joint_config()) as env:
        env.reset(seed=0)
        env.step(np.full(3, 2, np.float32))
        env.step(np.full(3, 2, np.float32))
        n_told = len(env.arm.robot.told)
        _, _, terminated, truncated, info = env.step(np.array([0, value, 0], np.float32))
        told = env.arm.robot.told[n_told:]
    assert truncated
    assert not terminated
    assert info["verdict"] == "discard"
    assert not info["is_success"]
    assert len(told) == 1  # it holds where it is, at once
    np.testing.assert_allclose(told[0][1], 2, atol=1e-6)
    assert [r.getMessage() for r in caplog.records if r.levelno == logging.ERROR] == [
        "The policy's action holds a value that is not finite (NaN). The robot holds."
    ]


def test_a_camera_that_stops_ends_the_attempt_and_the_next_one_goes_on(caplog):
    with robot_env(joint_config()) as env:
        env.reset(seed=0)
        env.step(REST)
        env.arm.robot.is_blind = True
        _, _, _, truncated, info = env.step(REST)
        assert truncated
        assert info["verdict"] == "discard"
        assert "does not answer: front latest frame is too old" in caplog.text
        with pytest.raises(RobotError, match="does not answer"):
            env.reset(seed=1)
        env.arm.robot.is_blind = False
        env.reset(seed=1)
        assert not env.step(REST)[3]


def test_a_frozen_picture_is_noticed(monkeypatch):
    with robot_env(joint_config(frozen_s=0.2, episode_s=5.0)) as env:
        env.reset(seed=0)
        monkeypatch.setattr(np, "roll", lambda picture, *_, **__: picture)
        steps = [env.step(REST) for _ in range(7)]
    assert [step[3] for step in steps].index(True) in (4, 5, 6)


def test_a_loop_that_stands_still_makes_the_arm_hold_and_ends_the_attempt(caplog):
    with robot_env(joint_config(stall_s=0.4)) as env:
        env.arm.robot.config.speed = 10.0  # units per second
        env.reset(seed=0)
        env.step(np.full(3, 9, np.float32))
        time.sleep(0.5)
        held = env.arm.robot.told[-1]
        assert held[1][:2].max() < 5  # where it was after a tenth of a second, and not where it was told to go
        sent = [when for when, target in env.arm.robot.told if target[0] == 9][-1]
        assert 0.09 < held[0] - sent < 0.2  # two ticks
        _, _, _, truncated, info = env.step(REST)
    assert truncated
    assert info["verdict"] == "discard"
    assert "stood still" in caplog.text


def test_a_person_begins_judges_and_stops():
    def press(status):
        if status.note.startswith("Set the scene up"):
            return "p"
        return "s" if status.step == 3 else None

    console = ScriptedConsole(press)
    with robot_env(joint_config(episode_s=5.0), console) as env:
        episode = play(env, SimpleNamespace(reset=lambda env: None, act=lambda o: REST), seed=0)
        assert episode.verdict is Verdict.SUCCESS
        assert episode.success
        assert len(episode) == 3
        assert episode.facts["ticks"] == 3
        console.on_show = lambda status: {3: "escape", 0: "p"}.get(status.step) if not status.note else "q"
        console.press("p")
        console.on_show = lambda s: "p" if "Set the scene" in s.note else "q" if s.note else "escape"
        episode = play(env, SimpleNamespace(reset=lambda env: None, act=lambda o: REST), seed=0)
        assert episode.verdict is Verdict.FAILURE
        assert not episode.success
        assert any(note.startswith("You pressed Escape.") for note in console.notes)
        told = env.arm.robot.told[-1][1]
        np.testing.assert_allclose(told, env.arm.robot.place, atol=1e-6)
        console.on_show = lambda s: "escape"
        with pytest.raises(PersonLeftError):
            env.reset(seed=1)


def test_the_arm_goes_to_rest_before_an_attempt():
    limits = {"max_step": None, "max_relative_target": None}
    with robot_env(joint_config(rest={"shoulder.pos": 9.0}, **limits)) as env:
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.full(3, 4, np.float32))
        env.reset(seed=1)
        time.sleep(0.02)
        assert env.arm.position() == pytest.approx({"shoulder.pos": 9.0, "elbow.pos": 4.0, "gripper.pos": 4.0})
    with robot_env(joint_config(rest={"wrist.pos": 3.0})) as env, pytest.raises(RobotError, match="its joints are"):
        env.reset(seed=0)
    with robot_env(joint_config(**limits)) as env:  # by default: where it was when the program began
        env.reset(seed=0)
        for _ in range(2):
            env.step(np.full(3, 4, np.float32))
        env.reset(seed=1)
        time.sleep(0.02)
        np.testing.assert_allclose(env.arm.robot.place, 0, atol=1e-6)


def test_two_environments_of_one_robot_share_it(wav):
    config = joint_config(wav)
    with robot_env(config) as one, robot_env(config) as other:
        assert one.arm is other.arm
        one.reset(seed=0)
        other.reset(seed=1)
        other.step(REST)
        other.close()
        one.reset(seed=2)
        one.step(REST)
        robot = one.arm.robot
        assert robot.is_connected
    assert not robot.is_connected


def test_ticks_do_not_drift_and_a_long_delay_moves_them():
    now = [0.0]

    def sleep(seconds):
        now[0] += seconds

    ticks = Ticks(10, clock=lambda: now[0], sleep=sleep)
    for _ in range(5):
        now[0] += 0.03
        ticks.wait()
    assert now[0] == pytest.approx(0.5)
    now[0] += 0.11  # a little late
    ticks.wait()
    assert ticks.n_late == 1
    ticks.wait()
    assert now[0] == pytest.approx(0.7)
    now[0] += 0.35
    ticks.wait()
    assert ticks.wait() == pytest.approx(1.15)
    assert ticks.n_late == 2


def test_a_standstill_before_a_tick_and_one_after_it_are_both_told():
    now = [0.0]
    ticks = Ticks(10, clock=lambda: now[0], sleep=lambda seconds: now.__setitem__(0, now[0] + seconds))
    ticks.wait()
    now[0] += 0.15  # of which 0.2 may be spent on waiting for sound
    assert ticks.standstill_s(0.2) == 0
    now[0] += 2
    assert ticks.standstill_s(0.2) == pytest.approx(1.95)
    ticks.wait()
    assert ticks.standstill_s(0.2) == pytest.approx(2.05)  # the tick came late
    ticks.wait()
    assert ticks.standstill_s(0.2) == 0


def test_ticks_that_come_late_are_told_where_they_are_many(caplog):
    now = [0.0]
    ticks = Ticks(10, clock=lambda: now[0], sleep=lambda seconds: now.__setitem__(0, now[0] + seconds))
    for late in [0.0] * 38 + [0.11] * 2:
        now[0] += late
        ticks.wait()
    assert ticks.account(2) == {"ticks": 40, "late_ticks": 2, "holds": 2}
    assert not caplog.text
    now[0] += 0.11
    ticks.wait()
    assert ticks.account(0) == {"ticks": 41, "late_ticks": 3, "holds": 0}
    assert "3 of 41 ticks came late" in caplog.text


def test_an_attempt_of_a_policy_that_is_too_slow_says_so(caplog):
    with robot_env(joint_config(fps=50, episode_s=0.2)) as env:
        for seed in (0, 1):  # the holds of the one are not those of the other
            env.reset(seed=seed)
            time.sleep(0.1)  # before the first action it may take long
            steps = [env.step(REST)]
            while not steps[-1][3]:
                assert "ticks" not in steps[-1][4]
                time.sleep(0.06)
                steps.append(env.step(REST))
            info = steps[-1][4]
            assert info["ticks"] == 10
            assert info["late_ticks"] > 5
            assert 5 <= info["holds"] <= 10
    warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warnings) == 2
    assert "of 10 ticks came late" in warnings[0]
    assert f"the arm was held {info['holds']} times for want of an action" in warnings[1]
    assert "longer than a tick's 20 ms" in warnings[1]


def test_lerobot_makes_one_robot_however_many_environments_it_asks_for(wav):
    from lerobot.envs import make_env

    config = joint_config(wav)
    (vec,) = make_env(config, n_envs=4)["playbyear_robot"].values()
    try:
        assert vec.num_envs == 1
        assert config.features_map["audio.gripper"] == "observation.audio.gripper"
        assert config.features["pixels/front"].shape == (48, 64, 3)
    finally:
        vec.close()


def test_slow_motion_is_refused():
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

    with (
        robot_env(joint_config(), ScriptedConsole()) as env,
        pytest.raises(ExpertError, match="no slow motion"),
    ):
        TeleopExpertConfig(steps_per_second=5).make(env)


def teleop(env, leader, **options):
    """A person with a leader arm beside a policy."""
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

    expert = TeleopExpertConfig(teleop=leader, play_sound=False, **options).make(env)
    return expert, expert.teleop


def test_a_key_cannot_be_held_in_a_terminal_and_its_name_may_be_a_capital(caplog):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    with robot_env(joint_config(), ScriptedConsole()) as env:
        expert, _ = teleop(env, JointLeaderConfig(), takeover="hold", takeover_key="Space")
        assert (expert.override, expert.toggles) == ("space", True)
        assert "--expert.takeover=hold: without a window nothing says when a key is let go" in caplog.text
        expert.close()


@pytest.mark.parametrize("has_motors", [False, True])
def test_leader_and_follower_meet_before_a_person_takes_over(has_motors):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    console = ScriptedConsole(lambda status: "p" if "Set the scene" in status.note else None)
    with robot_env(joint_config(episode_s=8.0, max_step=None, max_relative_target=None), console) as env:
        expert, leader = teleop(env, JointLeaderConfig(has_motors=has_motors))
        leader.place = {"shoulder.pos": 8.0, "elbow.pos": 4.0, "gripper.pos": -6.0}
        n_asked = [0]

        def act(observation):
            n_asked[0] += 1
            if n_asked[0] == 5:
                console.press("space")
            if n_asked[0] == 12:
                console.press("space")
            if n_asked[0] == 16:
                console.press("s")
            return np.ones(3, np.float32)

        episode = play(env, SimpleNamespace(reset=lambda env: None, act=act), seed=0, expert=expert)
        told = np.array([target for _, target in env.arm.robot.told])
        expert.close()
    assert episode.interventions.tolist() == [False] * 4 + [True] * 7 + [False] * 5
    assert len(episode) == n_asked[0]  # the policy is asked in every step: its memory goes on
    assert episode.success
    by_person = episode.actions[episode.interventions]
    assert np.abs(np.diff(told, axis=0)).max() < 8 if not has_motors else True
    if has_motors:  # the leader came to the follower, which was at 1
        np.testing.assert_allclose(by_person, 1, atol=1e-3)
        assert len(leader.fed) > 10
        assert not leader.is_held
    else:
        np.testing.assert_allclose(by_person, [[8, 4, -6]] * 7)
        jumps = np.abs(np.diff(told[:-8], axis=0)).max(axis=0)
        assert (jumps < 1.01).all()  # in small steps; the leader is up to 7 away
    facts = episode.facts
    assert facts["ticks"] == len(episode) - 1  # in the last step the verdict was said, and the arm did not move
    assert 12 < facts["rate_hz"] < 20.5  # without the time in which the arms met: with it, it would be 8


def test_a_leader_that_lacks_a_joint_is_refused():
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig
    from lerobot_playbyear.teleoperation.keyboard import KeyboardWindowTeleopConfig

    config = TeleopExpertConfig(teleop=KeyboardWindowTeleopConfig())
    needs = "the robot also needs elbow.pos, gripper.pos, shoulder.pos"
    with robot_env(joint_config(), ScriptedConsole()) as env, pytest.raises(ExpertError, match=needs):
        config.make(env)


def test_escape_while_a_person_acts_holds_and_asks():
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    pressed, pressed_at = [], []

    def press(status):
        if "Set the scene" in status.note:
            return "p"
        if status.note.startswith("You pressed Escape"):
            pressed.append(status.note)
            return "r"
        return None

    console = ScriptedConsole(press)
    with robot_env(joint_config(episode_s=4.0), console) as env:
        expert, _ = teleop(env, JointLeaderConfig())

        def act(observation):
            if env._ticks.n == 6:
                pressed_at.append(time.perf_counter())
                console.press("escape")
            return np.ones(3, np.float32)

        episode = play(env, SimpleNamespace(reset=lambda env: None, act=act), seed=0, expert=expert)
        assert episode.verdict is Verdict.DISCARD
        assert len(episode) in (6, 7)
        assert len(pressed) == 1
        told = [target for when, target in env.arm.robot.told if when > pressed_at[0]]
        np.testing.assert_allclose(told, [env.arm.robot.place], atol=1e-6)  # it was told to stay, and nothing else
        expert.close()


def test_a_pause_counts_for_nothing(wav):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    paused = [0]

    def press(status):
        if "Set the scene" in status.note:
            return "p"
        if status.note == "Press P to go on":
            paused[0] += 1
            return "p" if paused[0] == 10 else None
        return None

    console = ScriptedConsole(press)
    with robot_env(joint_config(wav), console) as env:
        expert, _ = teleop(env, JointLeaderConfig())

        def act(observation):
            if env._ticks.n == 6 and not paused[0]:
                console.press("p")
            return np.zeros(3, np.float32)

        episode = play(env, SimpleNamespace(reset=lambda env: None, act=act), seed=0, expert=expert)
        expert.close()
    assert paused[0] == 10
    assert len(episode) == 20
    assert episode.facts["drop_outs"] == {"gripper": []}
    assert episode.facts["rate_hz"] > 15  # with the pause it would be 13


def test_an_evaluation_can_be_paused_and_the_arm_holds_at_its_end():
    n_paused = [0]

    def press(status):
        if "Set the scene" in status.note:
            return "p"
        if status.note == "Press P to go on":
            n_paused[0] += 1
            return "p" if n_paused[0] == 5 else None
        return "p" if status.step == 4 and not n_paused[0] else None

    console = ScriptedConsole(press)
    with robot_env(joint_config(max_step=None, max_relative_target=None), console) as env:
        env.reset(seed=0)
        env.arm.robot.config.speed = 5.0  # units per second
        steps = [env.step(np.full(3, 10, np.float32)) for _ in range(20)]
        assert n_paused[0] == 5
        assert [step[3] for step in steps] == [False] * 19 + [True]
        assert env.episode_facts()["rate_hz"] > 17.5  # with the pause it would be 16.7
        assert env.arm.robot.told[-1][1][:2].max() < 9


def test_the_arm_goes_to_rest_when_the_person_says_so():
    notes = []

    def press(status):
        notes.append((status.note, env.arm.robot.place.max()))
        return "p" if status.note.startswith(("Press P to let", "Set the scene")) else None

    with robot_env(joint_config(max_step=None, max_relative_target=None), ScriptedConsole(press)) as env:
        env.reset(seed=0)
        assert [note for note, _ in notes] == ["Set the scene up, then press P to begin"]
        for _ in range(3):
            env.step(np.full(3, 8, np.float32))
        notes.clear()
        env.reset(seed=1)
    asked = [note for note, _ in notes if note]
    assert asked == ["Press P to let the arm go to its rest pose", "Set the scene up, then press P to begin"]
    assert notes[0][1] == pytest.approx(8)  # it had not moved yet


def test_no_demonstration_begins_where_the_disk_has_no_room_for_one(tmp_path, monkeypatch):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    from lerobot_playbyear.datasets.durable import DurableWriter
    from lerobot_playbyear.recording import demonstrations

    asked_for = []
    monkeypatch.setattr(demonstrations, "check_room", lambda writer, n_bytes: asked_for.append(n_bytes))
    with robot_env(joint_config(fps=50, episode_s=0.3), ScriptedConsole(begins)) as env:
        facts = env_facts(env)
        with DurableWriter("tests/arm", tmp_path / "data", facts.fps, dataset_features(facts)) as writer:
            expert, _ = teleop(env, JointLeaderConfig())
            episodes = demonstrations.PersonRollouts(env, expert, writer).episodes(range(2))
            assert len([*episodes]) == 2
            expert.close()
    assert asked_for[0] is None
    assert asked_for[1] > 10 * 48 * 64  # of noise, without loss


KEYS = [("\x1b", ["escape"]), ("\x1b[A p", ["up", "space", "p"]), ("\x1bOP\x1b[3~S", ["s"])]


@pytest.mark.parametrize(("sent", "names"), KEYS)
def test_keys_of_a_terminal(sent, names):
    from lerobot_playbyear.teleoperation.console import _names

    assert _names(sent) == names


def test_nobody_to_ask_is_an_error_unless_it_is_meant(monkeypatch):
    from lerobot_playbyear.teleoperation.console import make_console

    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(ExpertError, match=r"--env\.console=none"):
        make_console("auto", "robot")


def acting(n_acts, action=1.0):
    """An actor that presses keys: what it is asked for the n-th time, from 1 on."""
    asked = [0]

    def act(observation):
        asked[0] += 1
        n_acts(asked[0])
        return np.full(3, action, np.float32)

    return SimpleNamespace(reset=lambda env: None, act=act)


def begins(status):
    return "p" if "Set the scene" in status.note else None


def test_every_first_action_is_limited_too():
    with robot_env(joint_config(max_step=2.0, max_relative_target=None)) as env:
        env.reset(seed=0)
        env.step(np.full(3, 60, np.float32))
        assert env.arm.robot.told[-1][1].max() == pytest.approx(2)
        env.hold()
        env.go_on()
        env.step(np.full(3, 60, np.float32))
        assert env.arm.robot.told[-1][1].max() <= 4.01


def test_a_robot_that_mixes_places_and_velocities_gets_them_as_they_are_and_holds_its_places(monkeypatch):
    from lerobot_robot_playbyear_sim.joints import JointArm

    monkeypatch.setattr(JointArm, "action_features", property(lambda self: dict.fromkeys((*JOINTS, "base.vel"), float)))
    monkeypatch.setattr(
        JointArm,
        "observation_features",
        property(lambda self: {**dict.fromkeys((*JOINTS, "base.vel"), float), "front": (48, 64, 3)}),
    )
    told = []

    def send(self, action):
        told.append(dict(action))
        return action

    observe = JointArm.get_observation
    monkeypatch.setattr(JointArm, "get_observation", lambda self: {**observe(self), "base.vel": 0.3})
    monkeypatch.setattr(JointArm, "send_action", send)
    with robot_env(joint_config(max_step=None, max_relative_target=None)) as env:
        env.reset(seed=0)
        env.step(env.action_space.high.clip(max=40))
        assert told[-1] == pytest.approx(dict.fromkeys((*JOINTS, "base.vel"), 40))
        env.arm.robot.place = env.arm.robot.target = np.array([40.0, -30.0, 20.0])
        env.arm.hold()
    assert told[-1] == pytest.approx({"shoulder.pos": 40, "elbow.pos": -30, "gripper.pos": 40, "base.vel": 0})


JOINTS = ("shoulder.pos", "elbow.pos", "gripper.pos")


def test_a_gripper_that_was_moved_to_rest_is_not_told_to_close_again():
    with robot_env(joint_config(max_step=None, max_relative_target=None)) as env:
        env.reset(seed=0)
        env.step(np.array([0, 0, 90], np.float32))
        env.reset(seed=1)
        env.arm.hold()
        assert env.arm.robot.told[-1][1][2] == pytest.approx(0, abs=1)


def test_the_arm_is_never_told_to_go_to_a_place_that_is_not_finite():
    with robot_env(joint_config(rest={"shoulder.pos": float("nan")})) as env, pytest.raises(RobotError, match="finite"):
        env.reset(seed=0)


def test_escape_stops_the_move_to_rest_and_leaves():
    console = ScriptedConsole(lambda status: "p" if status.note else None)
    limits = {"max_step": None, "max_relative_target": None}
    with robot_env(joint_config(rest={"shoulder.pos": 50.0}, rest_s=2.0, **limits), console) as env:
        console.on_show = lambda status: "p" if status.note.startswith("Press P to let") else None
        move = env.arm.move_to

        def press_escape_soon(*args, **kwargs):
            import threading

            threading.Timer(0.5, console.press, ["escape"]).start()
            return move(*args, **kwargs)

        env.arm.move_to = press_escape_soon
        with pytest.raises(PersonLeftError):
            env.reset(seed=0)
        assert env.arm.robot.told[-1][1][0] < 30
        time.sleep(0.1)
        env.arm.robot.get_observation()
        assert env.arm.robot.place[0] == pytest.approx(env.arm.robot.told[-1][1][0])


def test_a_key_pressed_twice_does_not_begin_the_attempt_unseen():
    notes = []
    limits = {"max_step": None, "max_relative_target": None}

    def press(status):
        notes.append(status.note)
        if status.note.startswith("Press P to let"):
            console.press("p")
            return "p"
        return "p" if status.note.startswith("Set the scene") and len(notes) > 5 else None

    console = ScriptedConsole(press)
    with robot_env(joint_config(rest={"shoulder.pos": 9.0}, **limits), console) as env:
        env.reset(seed=0)
    assert sum(note.startswith("Set the scene") for note in notes) > 1


@pytest.mark.parametrize("key", ["r", "s", "q"])
def test_a_verdict_holds_the_arm_at_once(key):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    console = ScriptedConsole(begins)
    with robot_env(joint_config(episode_s=4.0, max_step=None, max_relative_target=None), console) as env:
        expert, _ = teleop(env, JointLeaderConfig())
        n_told = []

        def keys(n):
            if n == 5:
                n_told.append(len(env.arm.robot.told))
                console.press(key)

        episode = play(env, acting(keys, 60.0), seed=0, expert=expert)
        told = [target for _, target in env.arm.robot.told[n_told[0] :]]
        expert.close()
    assert len(episode) == 5
    assert len(told) == 1
    np.testing.assert_allclose(told[0][:2], env.arm.robot.place[:2], atol=1e-6)


def test_escape_while_the_arms_meet_stops_the_follower():
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    asked = []

    def press(status):
        if "Set the scene" in status.note:
            return "p"
        if status.note == "The arms meet":
            import threading

            threading.Timer(0.4, console.press, ["escape"]).start()
        if status.note.startswith("You pressed Escape"):
            asked.append(status.note)
            return "r"
        return None

    console = ScriptedConsole(press)
    with robot_env(joint_config(episode_s=4.0, max_step=None, max_relative_target=None), console) as env:
        expert, leader = teleop(env, JointLeaderConfig())
        leader.place = dict.fromkeys(leader.place, 80.0)
        episode = play(env, acting(lambda n: console.press("space") if n == 3 else None), seed=0, expert=expert)
        expert.close()
        assert episode.verdict is Verdict.DISCARD
        assert len(asked) == 1
        assert env.arm.robot.told[-1][1][:2].max() < 70


def test_after_a_pause_the_arms_meet_again_and_the_frame_is_that_of_then():
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    moved = []

    def press(status):
        if "Set the scene" in status.note:
            return "p"
        if status.note == "Press P to go on":
            leader.place = dict.fromkeys(leader.place, 40.0)  # it was put down
            moved.append(1)
            return "p" if len(moved) == 3 else None
        return None

    console = ScriptedConsole(press)
    with robot_env(joint_config(episode_s=3.0, max_step=None, max_relative_target=None), console) as env:
        expert, leader = teleop(env, JointLeaderConfig())

        def keys(n):
            console.press("space") if n == 3 else None
            console.press("p") if n == 8 else None
            console.press("s") if n == 15 else None

        episode = play(env, acting(keys), seed=0, expert=expert)
        told = np.array([target for _, target in env.arm.robot.told])
        expert.close()
    states = np.array([observation["agent_pos"] for observation in episode.observations])
    assert np.abs(np.diff(told[:, :2], axis=0)).max() < 5  # in small steps, 40 away
    far = np.abs(states[: len(episode)] - episode.actions).max(axis=1)
    assert far[2:7].max() < 3  # frames hold what was seen when the person acted, not before the arms had met
    assert far[7:14].max() < 3


@pytest.mark.parametrize("first", [0, 4])
def test_a_leader_that_does_not_answer_is_asked_about(first):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    def press(status):
        if "P tries again" in status.note:  # before the attempt, where nothing is to be judged
            del leader.get_action
            return "p"
        return "p" if "Set the scene" in status.note else "s" if "leader" in status.note else None

    console = ScriptedConsole(press)
    with robot_env(joint_config(episode_s=1.0), console) as env:
        expert, leader = teleop(env, JointLeaderConfig())

        def keys(n):
            if n == first:
                leader.get_action = lambda: (_ for _ in ()).throw(ConnectionError("no status packet"))

        keys(0)
        episode = play(env, acting(keys), seed=0, expert=expert)
        vars(leader).pop("get_action", None)
        expert.close()
    assert episode.success is (first > 0)
    assert (len(episode) == 20) is (first == 0)  # it goes on where the leader came back
    assert any("The leader does not answer: no status packet" in note for note in console.notes)


def test_a_camera_that_fails_while_the_person_sets_up_is_asked_about():
    shown = []

    def press(status):
        shown.append(status.note)
        if status.note.startswith("Set the scene") and len(shown) == 2:
            env.arm.robot.is_blind = True
        if "P tries again" in status.note:
            env.arm.robot.is_blind = False
            return "p"
        return "p" if status.note.startswith("Set the scene") and len(shown) > 4 else None

    with robot_env(joint_config(), ScriptedConsole(press)) as env:
        env.reset(seed=0)
        assert any("P tries again" in note for note in shown)
        assert not env.step(REST)[3]


def test_a_slow_first_action_costs_no_attempt():
    with robot_env(joint_config(stall_s=0.3)) as env:
        env.reset(seed=0)
        time.sleep(0.6)
        assert not env.step(REST)[3]
        assert env.episode_facts()["late_ticks"] == 0


def test_what_is_not_a_number_is_not_recorded():
    console = ScriptedConsole(lambda s: "p" if "Set the scene" in s.note else "s" if "not finite" in s.note else None)
    with robot_env(joint_config(), console) as env:
        actor = acting(lambda n: None)
        plain = actor.act
        actor.act = lambda o: plain(o) * (np.nan if env._ticks.n == 4 else 1)
        episode = play(env, actor, seed=0)
    assert episode.success
    assert len(episode) == 5
    assert np.isfinite(episode.actions).all()


def test_a_latency_longer_than_a_tick_is_refused():
    from draccus.utils import DecodingError

    from lerobot_playbyear.microphones.config import FileMicrophoneConfig

    with pytest.raises(DecodingError, match="latency_s"):
        joint_config(microphones={"gripper": FileMicrophoneConfig(path="x.wav", sample_rate=16000, latency_s=0.06)})


@pytest.mark.parametrize(("latency_s", "fps"), [(0.038, 25), (0.0396, 24), (0.004, 240), (0.6, 1)])
def test_the_calibration_tells_the_fastest_ticks_that_a_latency_allows(latency_s, fps):
    from draccus.utils import DecodingError

    from lerobot_playbyear.calibration.calibrate import told
    from lerobot_playbyear.calibration.estimator import Latency
    from lerobot_playbyear.microphones.config import FileMicrophoneConfig

    assert f"--env.fps={fps} or less" in told(Latency(latency_s, latency_s, 0.0, 0.0, (), 10), 48000)
    microphones = {"gripper": FileMicrophoneConfig(path="x.wav", latency_s=round(latency_s, 3))}
    assert joint_config(fps=fps, microphones=microphones).fps == fps
    faster = next(n for n in range(fps + 1, 48000) if 48000 % n == 0)
    with pytest.raises(DecodingError, match="wait for longer"):
        joint_config(fps=faster, microphones=microphones)


def test_one_robot_has_one_set_of_options():
    with robot_env(joint_config()), pytest.raises(RobotError, match="other options"), robot_env(joint_config(fps=10)):
        pass
