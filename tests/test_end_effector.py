"""Actions of the end effector: displacements of the hand become joints, with LeRobot's processors and placo."""

import time
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from draccus.utils import DecodingError
from robot_factory import ScriptedConsole, joint_config, robot_env

from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.robots.end_effector_config import EndEffectorConfig
from lerobot_playbyear.robots.parts import RobotError

needs_placo = pytest.mark.skipif(
    find_spec("placo") is None, reason='placo is not installed: pip install "lerobot[kinematics]"'
)
JOINTS = ("pan", "lift", "elbow", "wrist", "gripper")
BENT = {"pan.pos": 10.0, "lift.pos": -60.0, "elbow.pos": 90.0, "wrist.pos": -10.0, "gripper.pos": 50.0}
STEP = 0.01

_JOINT = """
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>"""
_CHAIN = (
    ("pan", "base", "turned", "0 0 0.1", "0 0 1"),
    ("lift", "turned", "upper", "0 0 0", "0 1 0"),
    ("elbow", "upper", "lower", "0.2 0 0", "0 1 0"),
    ("wrist", "lower", "palm", "0.2 0 0", "0 1 0"),
    ("gripper", "palm", "jaw", "0.05 0.01 0", "0 0 1"),
)


@pytest.fixture
def urdf(tmp_path):
    """An arm that turns on its base and has three joints in a plane, and a jaw."""
    links = "".join(f'<link name="{n}"/>' for n in ("base", "turned", "upper", "lower", "palm", "jaw", "tip"))
    keys = ("name", "parent", "child", "origin", "axis")
    joints = "".join(_JOINT.format(**dict(zip(keys, joint, strict=True))) for joint in _CHAIN)
    tip = (
        '<joint name="tip_fixed" type="fixed"><parent link="palm"/><child link="tip"/><origin xyz="0.08 0 0"/></joint>'
    )
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}{tip}</robot>')
    return path


def config(urdf, hand=None, **changes):
    from lerobot_robot_playbyear_sim import JointArmConfig

    options = {"urdf_path": str(urdf), "target_frame_name": "tip", "step_m": STEP, "gripper_step": 15.0}
    robot = changes.pop("robot", None) or JointArmConfig(joints=list(JOINTS), start=dict(BENT), speed=1e5)
    return joint_config(
        **{
            "robot": robot,
            "end_effector": EndEffectorConfig(**options | (hand or {})),
            "fps": 50,
            "max_relative_target": None,
            "episode_s": 60.0,
            **changes,
        }
    )


def hand(env):
    """Where the arm was told to bring the hand (3,) [m]."""
    return env._hand.position(env.arm.by_name(env.arm.robot.target))


def push(env, *action, n=10):
    for _ in range(n):
        result = env.step(np.array(action, np.float32))
    return result


@needs_placo
@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (0, -1), (1, 1), (2, -1)])
def test_the_hand_moves_along_one_axis_as_far_as_it_is_told(urdf, axis, sign):
    with robot_env(config(urdf)) as env:
        assert env.action_names == ["delta_x", "delta_y", "delta_z", "gripper"]
        assert env.action_space.contains(np.ones(4, np.float32))
        env.reset(seed=0)
        before = hand(env)
        action = np.zeros(4)
        action[axis] = sign
        push(env, *action)
        moved = hand(env) - before
        expected = np.zeros(3)
        expected[axis] = sign * 10 * STEP
        np.testing.assert_allclose(moved, expected, atol=0.0005)
        stays = env.arm.robot.target.copy()
        push(env, 0, 0, 0, 0)
        np.testing.assert_array_equal(env.arm.robot.target, stays)


@needs_placo
def test_an_arm_that_sags_does_not_creep(urdf):
    with robot_env(config(urdf)) as env:
        env.reset(seed=0)
        env.arm.robot.sag = np.array([0, 3.0, 3.0, 0, 0])  # degrees
        push(env, 0, 0, 0, 0, n=1)
        before = hand(env)
        push(env, 0, 1, 0, 0)
        np.testing.assert_allclose(hand(env) - before, [0, 10 * STEP, 0], atol=0.0005)


@needs_placo
def test_the_gripper_closes_above_zero_and_opens_below(urdf):
    with robot_env(config(urdf, max_step=20.0)) as env:
        env.reset(seed=0)
        told = []
        for command in (1, 1, 0, -0.5, *[-1] * 6, *[1] * 8):
            push(env, 0, 0, 0, command, n=1)
            told.append(env.arm.robot.target[4])
        np.testing.assert_allclose(told[:5], [35, 20, 20, 27.5, 42.5])
        assert max(told) == 100
        assert told[-1] == 0
    reverse = {"gripper_open": -5.0, "gripper_closed": 70.0}
    with robot_env(config(urdf, reverse, max_step=20.0)) as env:
        env.reset(seed=0)
        push(env, 0, 0, 0, 1, n=2)
        assert env.arm.robot.target[4] == 70


@needs_placo
def test_the_hand_stays_in_the_workspace_and_comes_back_at_once(urdf):
    bounds = {"bounds_min": [0.1, -0.1, 0.1], "bounds_max": [0.4, 0.1, 0.3]}
    with robot_env(config(urdf, bounds)) as env:
        env.reset(seed=0)
        before = hand(env)
        push(env, 1, 0, 0, 0, n=20)
        np.testing.assert_allclose(hand(env), [0.4, *before[1:]], atol=0.0005)
        push(env, -1, 0, 0, 0, n=1)
        np.testing.assert_allclose(hand(env)[0], 0.4 - STEP, atol=0.0005)


@needs_placo
def test_from_outside_of_the_workspace_the_hand_can_only_go_inwards(urdf):
    bounds = {"bounds_min": [0.0, -0.1, 0.2]}  # it begins 54 mm below
    with robot_env(config(urdf, bounds)) as env:
        env.reset(seed=0)
        before = hand(env)
        push(env, 0, 0, -1, 0, n=3)
        np.testing.assert_allclose(hand(env), before, atol=0.0005)
        push(env, 0, 0, 1, 0, n=3)
        np.testing.assert_allclose(hand(env) - before, [0, 0, 3 * STEP], atol=0.0005)
        push(env, 0, 0, -1, 0, n=3)
        np.testing.assert_allclose(hand(env) - before, [0, 0, 3 * STEP], atol=0.0005)


@needs_placo
def test_what_cannot_be_reached_is_left_out(urdf):
    with robot_env(config(urdf)) as env:
        env.reset(seed=0)
        before = hand(env)
        push(env, 1, 0, 0, 0, n=40)  # the arm is 0.48 m long
        told = np.array([target for _, target in env.arm.robot.told])
        farthest = hand(env)
        assert 0.4 < farthest[0] < 0.49
        np.testing.assert_allclose(farthest[1:], before[1:], atol=0.001)
        assert np.abs(np.diff(told, axis=0)).max() <= 10.001  # max_step
        push(env, -1, 0, 0, 0, n=10)
        back = hand(env) - farthest
        assert -10 * STEP < back[0] < -5 * STEP  # slower than it is told, where the joints have to turn far
        np.testing.assert_allclose(back[1:], 0, atol=0.001)


@needs_placo
@pytest.mark.parametrize("direction", [(1, 0, 0), (0.7, 0.7, 0), (0, 0, 1), (0.3, -0.3, 0.2)])
@pytest.mark.parametrize("max_step", [2.0, 10.0, None])
def test_the_hand_comes_back_from_wherever_it_got(urdf, direction, max_step):
    with robot_env(config(urdf, max_step=max_step)) as env:
        joints, action = env._hand, np.array([*direction, 0.0])
        env.reset(seed=0)
        for there in (action, -action):
            begins = hand(env)
            for _ in range(150):
                joints.send(there, env._last["agent_pos"])
                env.arm.robot.place = env.arm.robot.target
        assert np.linalg.norm(hand(env) - begins) > 0.1


@needs_placo
def test_the_limit_per_joint_holds(urdf):
    with robot_env(config(urdf, max_step=1.0)) as env:
        env.reset(seed=0)
        before = hand(env)
        push(env, 0, 1, 0, 0, n=20)
        told = np.array([target for _, target in env.arm.robot.told])
        moved = hand(env) - before
    assert 0.5 < np.abs(np.diff(told, axis=0)).max() <= 1.001
    assert 0.03 < moved[1] < 0.15  # slower than it is told, and along its line
    np.testing.assert_allclose(moved[[0, 2]], 0, atol=0.0005)


@needs_placo
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_never_reaches_the_robot(urdf, value):
    with robot_env(config(urdf)) as env:
        env.reset(seed=0)
        push(env, 1, 0, 0, 0, n=2)
        n_told, place = len(env.arm.robot.told), env.arm.robot.target.copy()
        _, _, terminated, truncated, info = env.step(np.array([0, value, 0, 0], np.float32))
        told = env.arm.robot.told[n_told:]
        assert (terminated, truncated, info["verdict"]) == (False, True, "discard")
        assert len(told) == 1  # it holds where it is
        np.testing.assert_allclose(told[0][1], place, atol=1e-4)
        with pytest.raises(ValueError, match="not finite"):
            env._hand.send(np.array([value, 0, 0, 0]), np.zeros(5))


@needs_placo
def test_after_a_hold_the_hand_begins_where_the_arm_was_held(urdf):
    with robot_env(config(urdf, stall_s=5.0)) as env:
        env.reset(seed=0)
        push(env, 0, 1, 0, 0)
        env.arm.robot.push(np.array([0, 5.0, 0, 0, 0]))  # somebody moves it, and then it is held there
        time.sleep(0.15)  # two ticks without an action: the watchdog's
        assert env._rig.watchdog.n_holds == 1
        held = env._hand.position(env.arm.position())
        push(env, 0, 0, 1, 0, n=2)
        np.testing.assert_allclose(hand(env) - held, [0, 0, 2 * STEP], atol=0.0005)


@needs_placo
def test_a_person_moves_it_with_the_keys_of_the_window(urdf):
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

    console = ScriptedConsole(lambda status: "p" if "Set the scene" in status.note else None)
    with robot_env(config(urdf, console="none"), console) as env:
        expert = TeleopExpertConfig(speed=0.5, takeover="hold", play_sound=False, gripper_cooldown_s=0.1).make(env)
        places = []

        def act(observation):
            places.append(hand(env))
            if env._ticks.n == 2:
                console.keys.note("space", True)
                console.keys.note("up", True)  # away: x of the base
            if env._ticks.n == 12:
                console.keys.note("up", False)
                console.keys.note("left", True)  # y of the base
            if env._ticks.n == 22:
                console.keys.note("left", False)
                console.press("g")
            if env._ticks.n == 26:
                console.press("s")
            return np.zeros(4, np.float32)

        episode = play(env, SimpleNamespace(reset=lambda env: None, act=act), seed=0, expert=expert)
        jaw = [target[4] for _, target in env.arm.robot.told]
        moved = hand(env) - places[0]
        expert.close()
    assert episode.success
    np.testing.assert_allclose(moved, [5 * STEP, 5 * STEP, 0], atol=0.001)
    acted = episode.actions[episode.interventions]
    assert acted[0].tolist() == [0.5, 0, 0, -1]
    assert [0, 0.5, 0, -1] in acted.tolist()
    assert jaw[-1] < max(jaw) == 100


@needs_placo
def test_a_leader_of_joints_is_refused(urdf):
    from lerobot_robot_playbyear_sim import JointLeaderConfig

    from lerobot_playbyear.dagger import ExpertError
    from lerobot_playbyear.teleoperation.config import TeleopExpertConfig

    with (
        robot_env(config(urdf), ScriptedConsole()) as env,
        pytest.raises(ExpertError, match="teleoperator of the end effector"),
    ):
        TeleopExpertConfig(teleop=JointLeaderConfig()).make(env)


def refused(config):
    from lerobot_playbyear.robots import rig

    with pytest.raises(RobotError) as caught, robot_env(config):
        pass
    assert not rig._rigs  # it was let go
    return str(caught.value)


def test_what_is_missing_is_said_before_anything_moves(urdf, tmp_path):
    from lerobot_robot_playbyear_sim import JointArmConfig

    option = "--env.end_effector"
    assert refused(config("nowhere.urdf")).startswith(f"{option}.urdf_path=nowhere.urdf: there is no such file.")
    assert refused(config("")).startswith(f"{option}.urdf_path=nothing: there is no such file.")
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot")
    assert "is no URDF" in refused(config(broken))
    frame = refused(config(urdf, {"target_frame_name": "toe"}))
    assert frame.startswith(f"{option}.target_frame_name=toe: ")
    assert "base, turned, upper" in frame
    names = refused(config(urdf, robot=JointArmConfig(joints=["pan", "shoulder", "gripper"])))
    assert "the robot also has shoulder" in names
    assert f"{option}.gripper=claw: the robot's joints are pan, lift" in refused(config(urdf, {"gripper": "claw"}))
    radians = JointArmConfig(joints=list(JOINTS), use_degrees=False)
    assert refused(config(urdf, robot=radians)).startswith(f"{option} needs joints in degrees")


@pytest.mark.skipif(find_spec("placo") is not None, reason="placo is installed")
def test_without_placo_one_line_says_what_to_install(urdf):
    message = refused(config(urdf))
    assert message.startswith("--env.end_effector needs placo")
    assert "pip install" in message


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("step_m", 0.0),
        ("gripper_step", np.nan),
        ("orientation_weight", -1.0),
        ("bounds_min", [0.0, 0.0]),
        ("bounds_max", [0.0, np.inf, 1.0]),
        ("gripper_closed", 100.0),
    ],
)
def test_options_that_do_not_work_are_refused(name, value):
    with pytest.raises(DecodingError, match="does not work") as caught:
        EndEffectorConfig(**{name: value})
    assert caught.value.key_path == ("env", "end_effector", name)


def test_a_workspace_has_its_corners_in_order():
    with pytest.raises(DecodingError, match="below that of bounds_max"):
        EndEffectorConfig(bounds_min=[0, 0, 0], bounds_max=[1, 0, 1])
