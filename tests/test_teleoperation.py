"""A person as expert, without a screen: what keys and LeRobot's teleoperators mean, and what becomes of it."""

import copy
import io
import json
from dataclasses import dataclass

import draccus
import numpy as np
import pytest
from gymnasium.spaces import Box
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, TeleopEvents
from lerobot.teleoperators.gamepad import GamepadTeleopConfig
from lerobot.teleoperators.keyboard import (
    KeyboardEndEffectorTeleopConfig,
    KeyboardTeleop,
    KeyboardTeleopConfig,
)

from gym_playbyear.panda import CartesianController, Panda
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import DaggerConfig, ExpertConfig, ExpertError, Verdict
from lerobot_playbyear.dagger.config import DatasetSource
from lerobot_playbyear.dagger.loop import outcome_of
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play as play_episode
from lerobot_playbyear.recording.demonstrations import Nobody
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.teleoperation.actions import CLOSE, DELTAS, OPEN, STAY, ActionMapping, Gripper
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig, connect_teleoperator
from lerobot_playbyear.teleoperation.controls import Controls
from lerobot_playbyear.teleoperation.expert import PersonLeftError, TeleopExpert
from lerobot_playbyear.teleoperation.keyboard import KeyboardWindowTeleop, KeyboardWindowTeleopConfig, WindowKeys
from lerobot_playbyear.teleoperation.levels import FLOOR_DB, as_float, level_db
from lerobot_playbyear.teleoperation.pace import Pace
from lerobot_playbyear.teleoperation.panel import FRAME, SIZE, draw
from lerobot_playbyear.teleoperation.speaker import Speaker
from lerobot_playbyear.teleoperation.status import Control, Status
from lerobot_playbyear.teleoperation.window import Window
from lerobot_playbyear.teleoperation.wire import Newest, receive, send

ARM = Box(-1.0, 1.0, (4,), np.float32)
HAND = {"dtype": "float32", "shape": (4,), "names": {**dict(zip(DELTAS, range(3), strict=True)), "gripper": 3}}


# LeRobot teleoperators that follow a script


@TeleoperatorConfig.register_subclass("test_scripted")
@dataclass
class ScriptedTeleopConfig(TeleoperatorConfig):
    """What is given at each step; the last one stays."""


class ScriptedTeleop(Teleoperator):
    config_class = ScriptedTeleopConfig
    name = "test_scripted"

    def __init__(self, config, actions=(), events=()):
        super().__init__(config)
        self.actions, self.events, self.n, self.is_on = list(actions), list(events), 0, False

    action_features = HAND
    feedback_features = {}  # noqa: RUF012
    is_calibrated = True

    @property
    def is_connected(self):
        return self.is_on

    def connect(self, calibrate=True):
        self.is_on = True

    def disconnect(self):
        self.is_on = False

    def calibrate(self): ...

    def configure(self): ...

    def send_feedback(self, feedback): ...

    def get_action(self):
        self.n += 1
        moves = self.actions[min(self.n, len(self.actions)) - 1] if self.actions else (0, 0, 0, STAY)
        return dict(zip((*DELTAS, "gripper"), moves, strict=True))

    def get_teleop_events(self):
        on = self.events[min(self.n, len(self.events)) - 1] if self.events else ()
        return {event: event in on for event in TeleopEvents}


def scripted(actions=(), events=()):
    teleop = ScriptedTeleop(ScriptedTeleopConfig(), actions, events)
    teleop.connect()
    return teleop


# Actions


@pytest.mark.parametrize(
    ("directions", "expected"), [("x,y,z", (0.5, 0, -0.25)), ("-y,x,z", (0, 0.5, -0.25)), ("z,-x,y", (-0.25, -0.5, 0))]
)
def test_directions_say_what_moves_the_hand_along_each_axis(directions, expected):
    action = {"delta_x": 1.0, "delta_y": 0.0, "delta_z": -0.5}
    vector = ActionMapping(HAND, ARM, directions, speed=0.5).vector(action, gripper=-1.0)
    np.testing.assert_allclose(vector, [*expected, -1.0])
    assert vector.dtype == np.float32


def test_an_action_stays_inside_the_environments_limits():
    small = Box(-0.1, 0.1, (3,), np.float32)
    vector = ActionMapping(HAND, small, "x,y,z", 1.0).vector({"delta_x": 9, "delta_y": -9, "delta_z": 0})
    np.testing.assert_allclose(vector, [0.1, -0.1, 0])


def test_a_teleoperator_with_as_many_numbers_as_the_action_passes_them_on():
    rover = {"linear_velocity": float, "angular_velocity": float}
    mapping = ActionMapping(rover, Box(-1, 1, (2,), np.float32), "x,y,z", speed=0.3)
    np.testing.assert_allclose(mapping.vector({"angular_velocity": -0.5, "linear_velocity": 0.8}), [0.8, -0.5])


def test_a_teleoperator_that_does_not_fit_is_refused():
    with pytest.raises(ExpertError, match=r"linear_velocity.*4 numbers.*keyboard_window"):
        ActionMapping({"linear_velocity": float}, ARM, "x,y,z", 0.3)


@pytest.mark.parametrize("directions", ["x,y", "x,y,y", "a,b,c", "--x,y,z", ""])
def test_directions_that_are_none_are_refused(directions):
    with pytest.raises(ExpertError, match="directions"):
        ActionMapping(HAND, ARM, directions, 0.3)


def test_the_gripper_is_told_what_the_arm_carries_out():
    """Whatever is wished, following the arm's own rule leaves both in the same state."""
    controller = CartesianController(Panda(), control_hz=20)
    controller.reset(np.array([-0.12, 0.0, 0.98]))
    gripper, rng = Gripper(round(Panda().gripper_cooldown * 20)), np.random.default_rng(0)
    n_changes = n_ignored = 0
    for _ in range(400):
        close, was_closed = bool(rng.random() < 0.5), gripper.is_closed
        told = gripper.wish(close)
        controller.command(np.array([0, 0, 0, 1.0 if told else -1.0]), controller.target)
        gripper.follow(told)
        assert controller._closed == gripper.is_closed == told
        n_changes, n_ignored = n_changes + (told != was_closed), n_ignored + (told != close)
    assert 5 <= n_changes <= 10
    assert n_ignored > 50


# Time, sound, messages


class Clock:
    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_steps_come_at_their_pace_and_late_ones_are_not_made_up_for():
    clock = Clock()
    pace = Pace(20, clock, clock.sleep)
    times = []
    for work in [0.01] * 5 + [0.2] + [0.01] * 3:
        pace.wait()
        times.append(clock.now)
        clock.now += work
    np.testing.assert_allclose(np.diff(times), [0.05] * 5 + [0.2] + [0.05] * 2)


@pytest.mark.parametrize(("work", "expected"), [(0.01, 20.0), (0.1, 10.0)])
def test_the_pace_that_was_kept_is_known(work, expected):
    clock = Clock()
    pace = Pace(20, clock, clock.sleep)
    assert pace.achieved_fps == 0
    for _ in range(40):
        pace.wait()
        clock.now += work
    assert pace.achieved_fps == pytest.approx(expected)
    assert Status(fps=20, achieved_fps=pace.achieved_fps).is_slow == (expected < 20)


def test_levels_are_those_of_full_scale():
    t = np.arange(800) / 16000
    sine = np.sin(2 * np.pi * 200 * t)
    assert level_db(sine) == pytest.approx(-3.01, abs=0.01)
    assert level_db(as_float((sine * 32767).astype(np.int16))) == pytest.approx(-3.01, abs=0.01)
    assert level_db(np.zeros(800)) == level_db(np.zeros(0)) == FLOOR_DB


def test_sound_plays_on_without_gaps_until_nothing_is_left():
    speaker = Speaker(16000, 4, "a test")
    speaker.play(np.full(4, 0.1))
    assert not speaker.take(4).any()  # one block could run dry at once
    speaker.play(np.full(4, 0.2))
    np.testing.assert_allclose(speaker.take(6), [0.1] * 4 + [0.2] * 2, atol=1e-7)
    np.testing.assert_allclose(speaker.take(4), [0.2, 0.2, 0, 0], atol=1e-7)
    for n in range(10):
        speaker.play(np.full(4, n))
    np.testing.assert_allclose(speaker.take(8), [4] * 4 + [5] * 4)  # what came too late is left out


def test_messages_arrive_as_they_were_sent():
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    status = Status(
        Control.PERSON, "Grasp", 2, 3, 9, 20.0, 19.5, "open", 0.5, {"gripper": [-30.5]}, "", [("P", "pause")]
    )
    stream = io.BytesIO()
    send(stream, (status, picture))
    send(stream, {"key": "space", "is_pressed": True})
    stream.seek(0)
    received, shown = receive(stream)
    np.testing.assert_array_equal(shown, picture)
    assert received == status
    assert receive(stream) == {"key": "space", "is_pressed": True}
    assert receive(stream) is None


def test_a_message_that_was_cut_off_is_none():
    stream = io.BytesIO()
    send(stream, (Status(), np.zeros((2, 2, 3), np.uint8)))
    for length in range(len(stream.getvalue())):
        assert receive(io.BytesIO(stream.getvalue()[:length])) is None


def test_only_the_newest_is_shown_and_a_picture_until_there_is_another():
    picture, newest = np.zeros((2, 2, 3), np.uint8), Newest()
    newest.set_pose(Status(step=1), picture)
    newest.set_pose(Status(step=2), None)
    assert newest.take() == (Status(step=2), picture)
    assert newest.take() is None
    newest.set_pose(Status(step=3), None)
    assert newest.take() == (Status(step=3), None)


# Keys and events


def press(keys, *names):
    for name in names:
        keys.note(name, True)
        keys.note(name, False)


def test_a_key_counts_while_it_is_held_and_once_if_it_was_only_tapped():
    keys = WindowKeys()
    keys.note("right", True)
    press(keys, "up")
    keys.look()
    assert (keys.held, keys.pressed) == ({"right", "up"}, ("right", "up"))
    keys.look()
    assert (keys.held, keys.pressed) == ({"right"}, ())
    keys.note("right", False)
    keys.look()
    assert keys.held == frozenset()


def test_the_windows_keys_move_the_hand_as_they_say():
    keys = WindowKeys()
    teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), keys)
    teleop.connect()
    expected = {
        "right": (1, 0, 0),
        "left": (-1, 0, 0),
        "up": (0, 1, 0),
        "down": (0, -1, 0),
        "e": (0, 0, 1),
        "d": (0, 0, -1),
    }
    for name, moves in expected.items():
        press(keys, name)
        keys.look()
        assert tuple(teleop.get_action().values()) == moves
    press(keys, "right", "up", "left", "e")
    keys.look()
    assert tuple(teleop.get_action().values()) == (0, 1, 1)


@pytest.mark.parametrize(
    ("name", "attribute", "value"),
    [
        ("space", "overrides", True),
        ("g", "toggles_gripper", True),
        ("p", "toggles_pause", True),
        ("s", "verdict", Verdict.SUCCESS),
        ("r", "verdict", Verdict.DISCARD),
        ("q", "verdict", Verdict.FAILURE),
        ("escape", "leaves", True),
    ],
)
def test_each_key_has_its_meaning_and_only_once(name, attribute, value):
    keys = WindowKeys()
    controls = Controls(scripted(), keys)
    nothing = getattr(controls.read(), attribute)
    press(keys, name)
    assert getattr(controls.read(), attribute) == value != nothing
    assert getattr(controls.read(), attribute) == nothing


def test_a_teleoperators_events_count_when_they_begin():
    held = (TeleopEvents.IS_INTERVENTION,)
    done = (TeleopEvents.SUCCESS, TeleopEvents.IS_INTERVENTION)
    controls = Controls(scripted(events=[(), held, held, done, done, ()]), WindowKeys())
    wishes = [controls.read() for _ in range(6)]
    assert [wish.overrides for wish in wishes] == [False, True, True, True, True, False]
    assert [wish.verdict for wish in wishes] == [None, None, None, Verdict.SUCCESS, None, None]


@pytest.mark.parametrize(
    ("events", "verdict"),
    [
        ({TeleopEvents.TERMINATE_EPISODE}, Verdict.FAILURE),
        ({TeleopEvents.TERMINATE_EPISODE, TeleopEvents.RERECORD_EPISODE}, Verdict.DISCARD),
        ({TeleopEvents.TERMINATE_EPISODE, TeleopEvents.SUCCESS}, Verdict.SUCCESS),
    ],
)
def test_terminate_says_less_than_what_is_beside_it(events, verdict):
    assert Controls(scripted(events=[events]), WindowKeys()).read().verdict is verdict


class Listening(ScriptedTeleop, KeyboardTeleop):
    """Hears the keyboard whichever window has it, as LeRobot's own does."""


def test_what_is_typed_into_other_windows_moves_nothing():
    pytest.importorskip("pynput", reason="LeRobot's keyboard needs pynput", exc_type=ImportError)
    keys = WindowKeys()
    on = {TeleopEvents.IS_INTERVENTION, TeleopEvents.SUCCESS}
    teleop = Listening(ScriptedTeleopConfig(), [(1, 0, 0, CLOSE)], [on])
    teleop.connect()
    controls = Controls(teleop, keys)
    wish = controls.read()
    assert (wish.overrides, wish.verdict) == (False, None)
    assert wish.action == {"delta_x": 0, "delta_y": 0, "delta_z": 0, "gripper": STAY}
    keys.has_focus = True
    wish = controls.read()
    assert (wish.overrides, wish.verdict, wish.action["delta_x"]) == (True, Verdict.SUCCESS, 1)


def test_a_teleoperator_without_events_and_one_that_left():
    keys = WindowKeys()
    teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), keys)
    assert Controls(teleop, keys).read().leaves
    teleop.connect()
    assert not Controls(teleop, keys).read().leaves


# The expert in an environment


class Screenless:
    """Keeps what a window would show, and can press keys when a step is shown."""

    def __init__(self, script=None):
        self.keys, self.is_open, self.shown, self.script = WindowKeys(), True, [], script or {}
        self.n_pauses = 0

    def show(self, status, picture=None):
        self.shown.append((copy.deepcopy(status), picture))
        if picture is None:
            self.n_pauses += status.control is Control.PAUSED
            on_pause = self.script.get("paused")
            if on_pause and status.control is Control.PAUSED and self.n_pauses == 3:
                on_pause(self)
        elif status.step in self.script:
            self.script[status.step](self)

    def close(self):
        self.is_open = False


def holding(*names):
    return lambda window: [window.keys.note(name, True) for name in names]


def letting_go(*names):
    return lambda window: [window.keys.note(name, False) for name in names]


def tapping(*names):
    return lambda window: press(window.keys, *names)


def play(script, teleop=None, begins_paused=False, demonstrates=False, horizon=30, toggles=False):
    """One attempt with a policy that does nothing. Returns the attempt and the window."""
    env = make_env(horizon)
    window = Screenless(script)
    if teleop is None:
        teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), window.keys)
        teleop.connect()
    mapping = ActionMapping(teleop.action_features, env.action_space, "x,y,z", 0.3)
    clock = Clock()
    speaker = Speaker(16000, 800, "a test")
    pace = Pace(20, clock, clock.sleep)
    how = {"begins_paused": begins_paused, "demonstrates": demonstrates, "toggles": toggles}
    expert = TeleopExpert(window, teleop, mapping, Gripper(40), pace, speaker, [], **how)
    try:
        return play_episode(env, Nobody(), seed=3, expert=expert), window
    finally:
        expert.close()
        env.close()


def make_env(horizon):
    sizes = {"image_size": 16, "visualization_width": 32, "visualization_height": 32}
    return env_spec(PlaybyearEnvConfig(**sizes, episode_length=horizon)).make()


def test_the_person_acts_on_exactly_the_steps_in_which_the_key_is_held():
    attempt, window = play({5: holding("space", "right"), 12: letting_go("space"), 15: letting_go("right")})
    flags = attempt.interventions
    assert np.flatnonzero(flags).tolist() == list(range(5, 12))
    np.testing.assert_allclose(attempt.actions[flags], np.tile([0.3, 0, 0, -1], (7, 1)), atol=1e-6)
    assert not attempt.actions[~flags].any()
    controls = [status.control for status, picture in window.shown if picture is not None]
    assert controls[6:13] == [Control.PERSON] * 7  # each step shows who acted in the one before
    assert controls[13:] == [Control.POLICY] * (len(controls) - 13)


def test_a_press_takes_over_and_another_hands_back():
    attempt, _ = play({5: tapping("space"), 12: tapping("space")}, toggles=True)
    assert np.flatnonzero(attempt.interventions).tolist() == list(range(5, 12))


def test_a_teleoperators_intervention_takes_over_with_its_own_action():
    events = [()] * 4 + [(TeleopEvents.IS_INTERVENTION,)] * 3 + [()]
    attempt, _ = play({}, scripted([(0, 1, 0, CLOSE)], events))
    flags = attempt.interventions
    assert np.flatnonzero(flags).tolist() == [3, 4, 5]  # one reading was made before the first step
    np.testing.assert_allclose(attempt.actions[flags], np.tile([0, 0.3, 0, 1], (3, 1)), atol=1e-6)


def test_a_pause_stops_the_simulation_and_nothing_else():
    held = {5: holding("space", "right"), 12: letting_go("space")}
    without, _ = play(held)
    paused, window = play({**held, 8: tapping("p"), "paused": tapping("p")})
    assert window.n_pauses == 3
    np.testing.assert_array_equal(paused.actions, without.actions)
    last = [attempt.observations[-1]["agent_pos"] for attempt in (paused, without)]
    np.testing.assert_array_equal(*last)


def test_an_attempt_can_wait_for_the_person():
    attempt, window = play({"paused": tapping("p")}, begins_paused=True)
    assert len(attempt) == 30
    assert [status.note for status, _ in window.shown if status.control is Control.PAUSED] == ["Press P to begin"] * 3


@pytest.mark.parametrize(
    ("name", "verdict", "outcome"),
    [("s", Verdict.SUCCESS, "kept"), ("q", Verdict.FAILURE, "failed"), ("r", Verdict.DISCARD, "discarded")],
)
def test_an_attempt_ends_when_the_person_says_so(name, verdict, outcome):
    attempt, _ = play({5: holding("space", "up"), 9: tapping(name)})
    assert (attempt.verdict, outcome_of(attempt), len(attempt)) == (verdict, outcome, 10)
    assert attempt.success == (verdict is Verdict.SUCCESS)


def test_an_attempt_can_be_ended_in_a_pause():
    attempt, _ = play({4: tapping("p"), "paused": tapping("r")})
    assert (attempt.verdict, len(attempt)) == (Verdict.DISCARD, 5)


def test_the_gripper_key_closes_and_opens_it_with_the_cool_down_between():
    presses = {3: tapping("g"), 20: tapping("g"), 50: tapping("g"), 60: tapping("g")}
    attempt, window = play({0: holding("space"), **presses}, horizon=80)
    commands = attempt.actions[:, 3]
    assert (np.flatnonzero(np.diff(commands)) + 1).tolist() == [3, 50]
    assert commands[:3].tolist() == [-1] * 3
    shown = {status.step: status for status, picture in window.shown if picture is not None}
    assert (shown[5].gripper, shown[5].cooldown_s) == ("closed", 1.95)
    assert shown[49].cooldown_s == 0


def test_the_gripper_key_does_nothing_while_the_policy_acts():
    attempt, _ = play({3: tapping("g"), 6: holding("space")})
    assert attempt.actions[6:, 3].tolist() == [-1] * 24


def test_a_teleoperator_says_close_stay_and_open():
    grips = [(0, 0, 0, grip) for grip in [STAY] * 3 + [CLOSE] + [STAY] * 50 + [OPEN] + [STAY]]
    attempt, _ = play({}, scripted(grips), demonstrates=True, horizon=70)
    assert (np.flatnonzero(np.diff(attempt.actions[:, 3])) + 1).tolist() == [2, 53]


def test_a_demonstration_is_the_persons_from_start_to_end():
    attempt, _ = play({4: holding("e"), 6: letting_go("e")}, demonstrates=True)
    assert attempt.interventions.all()
    assert np.flatnonzero(attempt.actions[:, 2]).tolist() == [4, 5]


def test_what_was_pressed_before_an_attempt_is_not_meant_for_it():
    env = make_env(8)
    window = Screenless()
    teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), window.keys)
    teleop.connect()
    clock = Clock()
    mapping = ActionMapping(teleop.action_features, env.action_space, "x,y,z", 0.3)
    pace, speaker = Pace(20, clock, clock.sleep), Speaker(16000, 800, "a test")
    expert = TeleopExpert(window, teleop, mapping, Gripper(40), pace, speaker, [], begins_paused=False)
    press(window.keys, "s", "g", "p", "right", "space")
    attempt = play_episode(env, Nobody(), seed=3, expert=expert)
    assert (attempt.verdict, len(attempt), attempt.intervention_share) == (None, 8, 0)
    press(window.keys, "escape")
    with pytest.raises(PersonLeftError):
        play_episode(env, Nobody(), seed=3, expert=expert)
    env.close()


@pytest.mark.parametrize("leave", [tapping("escape"), lambda window: window.close()])
def test_leaving_ends_the_command_as_ctrl_c_does(leave):
    with pytest.raises(PersonLeftError):
        play({5: leave})
    assert issubclass(PersonLeftError, KeyboardInterrupt)


def test_the_microphones_level_is_shown():
    _, window = play({})
    levels = [status.levels_db["gripper"] for status, picture in window.shown if picture is not None]
    assert [len(heard) for heard in levels] == list(range(1, 31))
    assert levels[3] == levels[-1][:4]
    assert all(FLOOR_DB < level < 0 for level in levels[-1])


# The window's picture


@pytest.mark.parametrize("control", Control)
def test_the_border_tells_who_acts(control):
    image = draw(Status(control))
    colour = tuple(int(FRAME[control][i : i + 2], 16) for i in (1, 3, 5))
    for x, y in ((3, 400), (698, 400), (300, 744), (400, 4)):
        assert tuple(image[y, x]) == colour


def test_long_texts_stay_inside_the_panel():
    status = Status(
        control=Control.POLICY,
        task="Grasp the red cube that nobody sees, wherever it may be, and lift it as high as you ever can. " * 3,
        attempt=1234,
        step=1234,
        n_steps=2000,
        fps=20,
        achieved_fps=3,
        gripper="closed",
        cooldown_s=1.9,
        levels_db={"gripper": [-20.0] * 200, "table": [-75.0]},
        sound="a very long reason for which no loudspeaker could be found on this machine",
        keys=[("Arrows", "right, left, away, near")] * 9,
    )
    image = draw(status)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    background = image[0, -1]
    assert (image[:, 985:] == background).all()
    assert (image[:, 706:724] == background).all()


# Options


def parsed(*options):
    args = ["--env.type=playbyear", "--dataset.repo_id=test/none", "--expert.type=teleop", *options]
    return draccus.parse(RecordConfig, args=args).expert


def test_the_options_choose_a_teleoperator_and_survive_being_saved():
    config = parsed("--expert.teleop.type=keyboard_ee", "--expert.teleop.use_gripper=false", "--expert.speed=0.5")
    assert isinstance(config, TeleopExpertConfig)
    assert config.teleop == KeyboardEndEffectorTeleopConfig(use_gripper=False)
    assert draccus.decode(ExpertConfig, json.loads(json.dumps(draccus.encode(config, ExpertConfig)))) == config


def test_a_resumed_run_has_the_same_person(tmp_path):
    """What playbyear-dagger keeps of its options, and reads again with --resume=true."""
    source = DatasetSource("test/none")
    expert = TeleopExpertConfig(KeyboardEndEffectorTeleopConfig(use_gripper=False), speed=0.4)
    path = tmp_path / "dagger_config.json"
    path.write_text(json.dumps(DaggerConfig(source, source, env=PlaybyearEnvConfig(), expert=expert).options()))
    assert draccus.parse(DaggerConfig, config_path=path, args=[]).expert == expert


def test_the_keyboard_of_the_window_is_the_default():
    assert parsed().teleop == KeyboardWindowTeleopConfig()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": 0.0}, "speed=0"),
        ({"gripper_cooldown_s": -1.0}, "gripper_cooldown_s=-1"),
        ({"steps_per_second": 0.0}, "steps_per_second=0"),
        ({"takeover_key": "f1"}, "takeover_key='f1': give a letter, a digit, or one of space"),
        ({"takeover_key": " "}, "takeover_key=' ': give"),
        ({"takeover_key": "P"}, "takeover_key='P' means something else"),
        ({"takeover_key": "e"}, "takeover_key='e' means something else"),
        ({"takeover": "press"}, "takeover='press': give hold or toggle"),
    ],
)
def test_bad_options_are_refused_before_a_window_opens(options, message):
    env = make_env(10)
    with pytest.raises(ExpertError, match=message):
        TeleopExpertConfig(**options).make(env)
    env.close()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (KeyboardEndEffectorTeleopConfig(), "pynput"),
        (GamepadTeleopConfig(), "gamepad"),
        (KeyboardTeleopConfig(), "keyboard_window"),
    ],
)
def test_a_teleoperator_that_cannot_work_says_what_is_missing(config, message, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ExpertError, match=message):
        connect_teleoperator(config, Screenless())


def test_teleoperators_of_other_packages_are_made_by_lerobot():
    teleop = connect_teleoperator(ScriptedTeleopConfig(), Screenless())
    assert isinstance(teleop, ScriptedTeleop)
    assert teleop.is_connected


def test_without_a_screen_the_window_says_so(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ExpertError, match=r"No window can be opened \(DISPLAY=''\)"):
        Window("test")


def test_only_a_script_or_a_person_demonstrates(tmp_path):
    @ExpertConfig.register_subclass("test_corrects_only")
    @dataclass
    class CorrectsOnly(ExpertConfig):
        def make(self, env): ...

    dataset = RecordDatasetConfig("test/none", str(tmp_path / "none"))
    cfg = RecordConfig(PlaybyearEnvConfig(), dataset, expert=CorrectsOnly())
    with pytest.raises(PlaybyearError, match="scripted or teleop"):
        record(cfg)
