"""A person whom the robot calls: the window is lit, it rings once, and they take over when they like."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_teleoperation import Clock, Nobody, Screenless, holding, letting_go, make_env

from lerobot_playbyear.dagger.methods.beside import Labelling, Staying
from lerobot_playbyear.dagger.methods.robot_gated import Asked, RobotGatedConfig
from lerobot_playbyear.episodes.expert import ExpertError
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.teleoperation.actions import ActionMapping, Gripper
from lerobot_playbyear.teleoperation.expert import TeleopExpert
from lerobot_playbyear.teleoperation.keyboard import KeyboardWindowTeleop, KeyboardWindowTeleopConfig
from lerobot_playbyear.teleoperation.pace import Pace
from lerobot_playbyear.teleoperation.speaker import Speaker
from lerobot_playbyear.teleoperation.status import Control


class Asking:
    """A robot that asks in steps 5 to 9, and its method at once."""

    def __init__(self):
        self.n = -1

    def asking(self):
        return self

    def state_of_mind(self, policy_action):
        return 0.0, 0.0

    def asks(self, novelty, risk):
        self.n += 1
        return 5 <= self.n < 10


def attempt(script, beside):
    """One attempt of 20 steps, with what was shown of each, and how often it rang."""
    env, window, clock = make_env(20), Screenless(script), Clock()
    teleop = KeyboardWindowTeleop(KeyboardWindowTeleopConfig(), window.keys)
    teleop.connect()
    mapping = ActionMapping(teleop.action_features, env.action_space, "x,y,z", 0.3)
    rings, speaker = [], Speaker(16000, 800, "a test")
    speaker.ring = lambda: rings.append(True)
    pace = Pace(20, clock, clock.sleep)
    person = TeleopExpert(window, teleop, mapping, Gripper(40), pace, speaker, [], begins_paused=False)
    try:
        episode = play(env, Nobody(), seed=3, expert=beside(person))
    finally:
        person.close()
        env.close()
    shown = [status.control for status, picture in window.shown if picture is not None]
    return np.flatnonzero(episode.interventions).tolist(), shown, len(rings)


def test_the_robot_calls_and_does_not_take_over():
    steps, shown, n_rings = attempt({}, lambda person: Asked(person, Asking()))
    assert (steps, n_rings) == ([], 1)
    assert [n for n, control in enumerate(shown) if control is Control.CALLED] == list(range(5, 10))


def test_a_person_who_was_called_acts_as_long_as_they_like():
    asked = []

    def beside(person):
        asked.append(Asked(person, Asking()))
        return asked[0]

    steps, shown, _ = attempt({7: holding("space"), 13: letting_go("space")}, beside)
    assert steps == list(range(7, 13))
    assert [control for control in shown if control is Control.CALLED] == [Control.CALLED] * 3
    assert (asked[0].n_asked, asked[0].n_calls) == (5, 1)


def test_without_a_hand_back_one_press_is_for_the_whole_attempt():
    steps, shown, _ = attempt({7: holding("space"), 9: letting_go("space")}, Staying)
    assert steps == list(range(7, 20))
    assert shown[8:] == [Control.PERSON] * len(shown[8:])


def test_a_person_who_is_called_cannot_be_kept():
    method = RobotGatedConfig(hands_back=False).make(SimpleNamespace())
    with pytest.raises(ExpertError, match=r"--method\.hands_back=false.*--expert\.type=scripted"):
        attempt({}, method.beside)
    method = RobotGatedConfig(redo_failed=True).make(SimpleNamespace())
    with pytest.raises(ExpertError, match=r"--method\.redo_failed=true.*--expert\.type=scripted"):
        attempt({}, method.beside)


def test_nobody_labels_what_somebody_else_does():
    with pytest.raises(
        ExpertError, match=r"--method\.type=dagger asks the expert in every step.*--expert\.type=scripted"
    ):
        attempt({}, Labelling)


def test_the_bell_is_heard_above_silence_and_ends():
    speaker = Speaker(16000, 800, "a test")
    speaker._stream = object()
    speaker.ring()
    heard = np.concatenate([speaker.take(800) for _ in range(8)])
    assert np.abs(heard[:800]).max() > 0.2
    assert not heard[-800:].any()
