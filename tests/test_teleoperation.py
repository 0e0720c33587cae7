"""A person as expert, without a screen: what keys and LeRobot's teleoperators mean, and what becomes of it."""

import copy
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import draccus
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from lerobot.rollout.configs import DAggerKeyboardConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, TeleopEvents
from lerobot.teleoperators.gamepad import GamepadTeleopConfig
from lerobot.teleoperators.keyboard import KeyboardEndEffectorTeleopConfig, KeyboardTeleopConfig

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.dagger.methods import Method
from lerobot_playbyear.dagger.robot_gated import Asked
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.experts import ExpertError
from lerobot_playbyear.episodes.play import Verdict
from lerobot_playbyear.episodes.play import play as play_episode
from lerobot_playbyear.recording.record import Nobody
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig, connect_teleoperator
from lerobot_playbyear.teleoperation.controls import (
    CLOSE,
    DELTAS,
    KEYS,
    MOVES,
    OPEN,
    OVERRIDE,
    PAUSE,
    STAY,
    TAKEN,
    ActionMapping,
    KeyboardWindowTeleop,
    KeyboardWindowTeleopConfig,
    PersonLeftError,
)
from lerobot_playbyear.teleoperation.expert import Pace, TeleopExpert
from lerobot_playbyear.teleoperation.panel import Control, Status
from lerobot_playbyear.teleoperation.speaker import FLOOR_DB, Speaker
from lerobot_playbyear.teleoperation.window import WindowKeys

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
        self.actions, self.events, self.n = list(actions), list(events), 0

    action_features = HAND
    feedback_features = {}  # noqa: RUF012
    is_calibrated = is_connected = True

    def connect(self, calibrate=True): ...

    def disconnect(self): ...

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
    return ScriptedTeleop(ScriptedTeleopConfig(), actions, events)


# Actions


@pytest.mark.parametrize(
    ("directions", "expected"), [("x,y,z", (0.5, 0, -0.25)), ("-y,x,z", (0, 0.5, -0.25)), ("z,-x,y", (-0.25, -0.5, 0))]
)
def test_directions_say_what_moves_the_hand_along_each_axis(directions, expected):
    action = {"delta_x": 1.0, "delta_y": 0.0, "delta_z": -0.5}
    vector = ActionMapping(HAND, ARM, directions, speed=0.5).vector(action, gripper=-1.0)
    np.testing.assert_allclose(vector, [*expected, -1.0])
    assert vector.dtype == np.float32


def test_a_teleoperator_with_as_many_numbers_as_the_action_passes_them_on():
    rover = {"linear_velocity": float, "angular_velocity": float}
    mapping = ActionMapping(rover, Box(-1, 1, (2,), np.float32), "x,y,z", speed=0.3)
    np.testing.assert_allclose(mapping.vector({"angular_velocity": -0.5, "linear_velocity": 0.8}), [0.8, -0.5])


@pytest.mark.parametrize(
    ("features", "directions", "said"),
    [
        ({"linear_velocity": float}, "x,y,z", r"linear_velocity.*4 numbers.*keyboard_window"),
        (HAND, "x,y,y", r"--expert.directions='x,y,y': give x, y and z"),
        (HAND, "--x,y,z", "--expert.directions='--x,y,z'"),
    ],
)
def test_a_teleoperator_that_does_not_fit_and_directions_that_are_none_are_refused(features, directions, said):
    with pytest.raises(ExpertError, match=said):
        ActionMapping(features, ARM, directions, 0.3)


# Time and sound


class Clock:
    now = 0.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_late_steps_are_not_made_up_for_and_a_pace_that_cannot_be_kept_is_told():
    clock = Clock()
    pace = Pace(20, clock, clock.sleep)
    times = []
    for work in [0.01] * 30 + [0.2] + [0.01] * 3 + [0.1] * 30:
        is_slow = Status(fps=20, achieved_fps=pace.achieved_fps).is_slow
        assert not is_slow or len(times) > 30
        pace.wait()
        times.append(clock.now)
        clock.now += work
    np.testing.assert_allclose(np.diff(times), [0.05] * 30 + [0.2] + [0.05] * 3 + [0.1] * 29)
    assert is_slow
    assert pace.achieved_fps == pytest.approx(10)


# Keys and events


def press(keys, *names):
    for name in names:
        keys.note(name, True)
        keys.note(name, False)


def test_the_windows_keys_move_the_hand_as_they_say():
    keys = WindowKeys()
    teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), keys)
    teleop.connect()
    moved = []
    for names in (["right"], ["left"], ["up"], ["down"], ["e"], ["d"], ["right", "up", "left", "e"]):
        press(keys, *names)
        keys.look()
        moved.append(tuple(teleop.get_action().values()))
    assert moved == [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (0, 1, 1)]


def test_the_keys_are_lerobots_and_the_page_and_the_panel_say_what_they_do():
    lerobots = DAggerKeyboardConfig()
    assert (lerobots.pause_resume, lerobots.correction) == (PAUSE, OVERRIDE)
    letters = {name.strip().lower() for label in KEYS for name in label.split(",")}
    arrows = {"up", "down", "left", "right"}
    names = {"escape": "esc", **dict.fromkeys(arrows, "arrows")}
    assert {names.get(name, name) for name in (*TAKEN, *MOVES, OVERRIDE)} == letters
    page = (Path(__file__).parents[1] / "docs/how_to/record.md").read_text()
    for label, meaning in KEYS.items():
        assert f"| {label} | {meaning} |" in page
    window = Screenless()
    make_person(make_env(), window)
    assert dict(window.shown[-1][0].keys) == KEYS


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


def make_person(env, window, teleop=None, demonstrates=False, **options):
    """A person to whom time is made up."""
    if teleop is None:
        teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), window.keys)
        teleop.connect()
    config = TeleopExpertConfig(play_sound=False, begin_paused=False, directions="x,y,z", **options)
    person, clock = TeleopExpert(config, env, window, teleop, demonstrates), Clock()
    person.pace = Pace(20, clock, clock.sleep)
    return person


@cache
def make_env(horizon=30, sound="none"):
    sizes = {"image_size": 16, "visualization_width": 32, "visualization_height": 32}
    return env_spec(PlaybyearEnvConfig(**sizes, episode_length=horizon, sound=sound)).make()


def play(script, teleop=None, env=None, beside=lambda person: person, **how):
    """One attempt with a policy that does nothing. Returns the attempt and the window.

    Args:
        script: What is pressed, by step.
        teleop: Instead of the window's keyboard.
        env: Another environment than that of 30 steps without sound.
        beside: Makes the expert of the person, as a method of HG-DAgger does.
        how: Further options of the person.
    """
    env, window = env or make_env(), Screenless(script)
    person = make_person(env, window, teleop, **how)
    try:
        return play_episode(env, Nobody(), seed=3, expert=beside(person)), window
    finally:
        person.close()


@pytest.mark.parametrize(("takeover", "begin", "end"), [("hold", holding, letting_go), ("toggle", tapping, tapping)])
def test_the_person_acts_on_exactly_the_steps_in_which_the_key_is_held(takeover, begin, end):
    """Or between two presses."""
    presses = {4: holding("right"), 5: begin("tab"), 12: end("tab"), 15: letting_go("right")}
    attempt, window = play(presses, takeover=takeover)
    flags = attempt.interventions
    assert np.flatnonzero(flags).tolist() == list(range(5, 12))
    np.testing.assert_allclose(attempt.actions[flags], np.tile([0.3, 0, 0, -1], (7, 1)), atol=1e-6)
    assert not attempt.actions[~flags].any()
    controls = [status.control for status, picture in window.shown if picture is not None]
    assert controls[6:13] == [Control.PERSON] * 7  # each step shows who acted in the one before
    assert controls[13:] == [Control.POLICY] * (len(controls) - 13)


@pytest.mark.parametrize(
    ("beside", "verdict"),
    [((), Verdict.FAILURE), ((TeleopEvents.SUCCESS, TeleopEvents.IS_INTERVENTION), Verdict.SUCCESS)],
)
def test_a_teleoperators_events_take_over_with_its_own_action_and_end_the_attempt(beside, verdict):
    """To terminate says less than what is beside it."""
    held = (TeleopEvents.IS_INTERVENTION,)
    events = [(), (), (), (), held, held, held, (), (), (TeleopEvents.TERMINATE_EPISODE, *beside)]
    attempt, _ = play({}, scripted([(0, 1, 0, CLOSE)], events))
    assert (attempt.verdict, len(attempt)) == (verdict, 9)
    flags = attempt.interventions
    assert np.flatnonzero(flags)[:3].tolist() == [3, 4, 5]  # one reading was made before the first step
    np.testing.assert_allclose(attempt.actions[flags][:3], np.tile([0, 0.3, 0, 1], (3, 1)), atol=1e-6)


def test_a_pause_stops_the_simulation_and_nothing_else():
    held = {4: holding("right"), 5: tapping("tab"), 12: tapping("tab")}
    without, _ = play(held)
    paused, window = play({**held, 8: tapping("space"), "paused": tapping("space")})
    assert window.n_pauses == 3
    np.testing.assert_array_equal(paused.actions, without.actions)
    last = [attempt.observations[-1]["agent_pos"] for attempt in (paused, without)]
    np.testing.assert_array_equal(*last)


def test_in_a_pause_the_key_that_takes_over_goes_on_with_the_person():
    attempt, window = play({8: tapping("space"), "paused": tapping("tab")})
    assert window.n_pauses == 3
    assert np.flatnonzero(attempt.interventions).tolist() == list(range(8, 30))


@pytest.mark.parametrize("solved", [False, True])
def test_an_attempt_that_is_ended_counts_as_the_environment_judges(solved):
    class Judging(gym.Wrapper):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, "is_success": solved}

    attempt, _ = play({4: tapping("enter")}, env=Judging(make_env()))
    assert (len(attempt), attempt.success) == (5, solved)


@pytest.mark.parametrize(
    ("name", "verdict", "outcome"),
    [
        ("s", Verdict.SUCCESS, "kept"),
        ("f", Verdict.FAILURE, "failed"),
        ("enter", Verdict.ENDED, "failed"),
        ("r", Verdict.DISCARD, "discarded"),
    ],
)
def test_an_attempt_ends_when_the_person_says_so(name, verdict, outcome):
    attempt, _ = play({5: holding("tab", "up"), 9: tapping(name)})
    assert (attempt.verdict, Method().outcome(attempt), len(attempt)) == (verdict, outcome, 10)
    assert attempt.success == (verdict is Verdict.SUCCESS)


def test_the_gripper_key_closes_and_opens_it_with_the_cool_down_between():
    presses = {3: tapping("g"), 20: tapping("g"), 45: tapping("g"), 50: tapping("g")}
    attempt, window = play({0: tapping("tab"), **presses}, env=make_env(52))
    commands = attempt.actions[:, 3]
    assert (np.flatnonzero(np.diff(commands)) + 1).tolist() == [3, 45]
    assert commands[:3].tolist() == [-1] * 3
    shown = {status.step: status for status, picture in window.shown if picture is not None}
    assert (shown[5].gripper, shown[5].cooldown_s) == ("closed", 1.95)
    assert shown[44].cooldown_s == 0


def test_a_teleoperator_says_close_stay_and_open():
    grips = [(0, 0, 0, grip) for grip in [STAY] * 3 + [CLOSE] + [STAY] * 41 + [OPEN] + [STAY]]
    attempt, _ = play({}, scripted(grips), make_env(52), demonstrates=True)
    assert (np.flatnonzero(np.diff(attempt.actions[:, 3])) + 1).tolist() == [2, 44]


def test_a_demonstration_is_the_persons_from_start_to_end():
    attempt, _ = play({4: holding("e"), 6: letting_go("e")}, demonstrates=True)
    assert attempt.interventions.all()
    assert np.flatnonzero(attempt.actions[:, 2]).tolist() == [4, 5]


def test_what_was_pressed_before_an_attempt_is_not_meant_for_it():
    env, window = make_env(), Screenless()
    expert = make_person(env, window)
    press(window.keys, "s", "g", "enter", "right", "space", "tab")
    attempt = play_episode(env, Nobody(), seed=3, expert=expert)
    assert (attempt.verdict, len(attempt), attempt.intervention_share) == (None, 30, 0)
    press(window.keys, "escape")
    with pytest.raises(PersonLeftError):
        play_episode(env, Nobody(), seed=3, expert=expert)


@pytest.mark.parametrize("leave", [tapping("escape"), lambda window: window.close()])
def test_leaving_ends_the_command_as_ctrl_c_does(leave):
    with pytest.raises(PersonLeftError):
        play({5: leave})
    assert issubclass(PersonLeftError, KeyboardInterrupt)


def test_the_microphones_level_is_shown():
    _, window = play({}, env=make_env(sound="waveform"))
    levels = [status.levels_db["gripper"] for status, picture in window.shown if picture is not None]
    assert [len(heard) for heard in levels] == list(range(1, 31))
    assert levels[3] == levels[-1][:4]
    assert all(FLOOR_DB < level < 0 for level in levels[-1])


# A robot that asks


class Asking:
    """The method of a robot that begins to ask in step 5."""

    def __init__(self):
        self.n = -1

    def asks(self, policy_action):
        self.n += 1
        return self.n == 5


def test_the_robot_calls_and_a_person_who_came_is_called_no_more(monkeypatch):
    rings = []
    monkeypatch.setattr(Speaker, "ring", lambda speaker: rings.append(True))
    held = {7: tapping("tab"), 13: tapping("tab")}
    attempt, window = play(held, beside=lambda person: Asked(person, Asking()))
    shown = [status.control for status, picture in window.shown if picture is not None]
    assert np.flatnonzero(attempt.interventions).tolist() == list(range(7, 13))
    assert [n for n, control in enumerate(shown) if control is Control.CALLED] == [5, 6, 7]
    assert len(rings) == 1


# Options


def test_a_resumed_run_has_the_same_person(tmp_path):
    """What playbyear-dagger keeps of its options, and reads again with --resume=true."""
    source = DatasetPlace("test/none")
    expert = TeleopExpertConfig(GamepadTeleopConfig(use_gripper=False), speed=0.4)
    path = tmp_path / "dagger_config.json"
    path.write_text(json.dumps(DaggerConfig(source, source, env=PlaybyearEnvConfig(), expert=expert).options()))
    assert draccus.parse(DaggerConfig, config_path=path, args=[]).expert == expert


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (KeyboardEndEffectorTeleopConfig(), "give --expert.teleop.type=keyboard_window"),
        (GamepadTeleopConfig(), "gamepad"),
        (KeyboardTeleopConfig(), "keyboard_window"),
    ],
)
def test_a_teleoperator_that_cannot_work_says_what_is_missing(config, message, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ExpertError, match=message):
        connect_teleoperator(config, Screenless())


def test_an_arm_that_no_longer_answers_is_told_as_what_it_is():
    """LeRobot's bus raises ConnectionError, which is an OSError, as are those of a full disk."""

    class Unplugged(ScriptedTeleop):
        def get_action(self):
            raise ConnectionError("There is no status packet!")

    with pytest.raises(ExpertError, match="no longer answers: There is no status packet"):
        play({}, Unplugged(ScriptedTeleopConfig()), demonstrates=True)
