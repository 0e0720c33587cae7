"""A person in a real window on a virtual screen, with real key events (Xvfb, xdotool)."""

import subprocess
import sys
import threading

import gymnasium as gym
import numpy as np
import pytest
from dagger_factory import arguments, column, corrections, metrics
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from support.shared import trained
from virtual_screen import VirtualScreen, needs_screen, wait_for

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.policy_actor import PolicyActor
from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy
from lerobot_playbyear.recording.record import RecordConfig, RecordDatasetConfig, record
from lerobot_playbyear.teleoperation.config import TeleopExpertConfig
from lerobot_playbyear.teleoperation.panel import FRAME, Control
from lerobot_playbyear.teleoperation.window import Window

pytestmark = [pytest.mark.usefixtures("one_thread"), needs_screen]
_TITLE = "Play it by ear"
_MOVES = {"Right": (0, 1), "Up": (1, 1), "d": (2, -1)}  # X's names of keys: axis of the environment, sign


@pytest.fixture
def screen(monkeypatch):
    screen = VirtualScreen()
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", screen.display)
    yield screen
    screen.close()


def env_config(**options):
    sizes = {"image_size": 16, "visualization_width": 96, "visualization_height": 96}
    return PlaybyearEnvConfig(**sizes, **options)


def state_shown(screen):
    """Who acts, as the border on the screen says; None if there is no window."""
    colour = "#{:02x}{:02x}{:02x}".format(*screen.picture()[400, 4])
    return next((control for control, frame in FRAME.items() if frame == colour), None)


class Person(gym.Wrapper):
    """Presses and releases keys between two steps of an environment, and goes on when the window has heard of it.

    Args:
        env: The environment.
        screen: Where the keys are pressed.
        held: For each key, the steps in which it is held, from and to.
        shown: Who acts, as the screen says once it has drawn the state after some steps, by step.
    """

    def __init__(self, env, screen, held, shown):
        super().__init__(env)
        self.screen, self.held, self.shown = screen, held, shown
        self.expert, self.n, self.positions, self.opening = None, 0, [], None

    def reset(self, **kwargs):
        result = super().reset(**kwargs)
        self.n, self.positions = 0, [self.unwrapped.eef_position]
        return result

    def step(self, action):
        result = super().step(action)
        self.positions.append(self.unwrapped.eef_position)
        self.opening = self.unwrapped.finger_positions.sum() if self.n == 29 else self.opening
        if self.n in self.shown:  # on a busy machine a window is some pictures behind
            wait_for(lambda: state_shown(self.screen) is self.shown[self.n], timeout_s=10)
        self.n += 1
        for name, (first, after) in self.held.items():
            if self.n == first:
                self.screen.hold(name)
            if self.n == after:
                self.screen.let_go(name)
            if self.n in (first, after):
                is_held = self.n == first
                wait_for(lambda name=name, is_held=is_held: (name.lower() in self.window.keys._held) is is_held)
        return result

    @property
    def window(self):
        return self.expert.window


class Remembering(PolicyActor):
    """The trained policy, which remembers what it wanted to do."""

    def __init__(self, env_cfg):
        policy = PlaybyearPolicy.from_pretrained(trained())
        super().__init__(policy, env_cfg, *make_pre_post_processors(policy.config, str(trained())))
        self.wanted = []

    def act(self, observation):
        self.wanted.append(super().act(observation))
        return self.wanted[-1]


@pytest.mark.slow
def test_an_override_is_recorded_on_exactly_the_held_frames_and_the_arm_moves_as_the_keys_say(screen):
    env_cfg = env_config(episode_length=36)
    held = {"Tab": (6, 30), "Right": (7, 13), "Up": (15, 21), "d": (23, 28)}
    shown = {3: Control.POLICY, 18: Control.PERSON, 34: Control.POLICY}
    env = Person(env_spec(env_cfg).make(), screen, held, shown)
    actor = Remembering(env_cfg)
    env.expert = TeleopExpertConfig(begin_paused=False, takeover="hold", play_sound=False).make(env)
    try:
        screen.focus(screen.window(_TITLE))
        episode = play(env, actor, seed=5, expert=env.expert)
        axes = env.unwrapped.data.cam("people").xmat.reshape(3, 3)
    finally:
        env.expert.close()
        env.close()

    assert np.flatnonzero(episode.interventions).tolist() == list(range(6, 30))
    expected = np.zeros((24, 4), np.float32)
    expected[:, 3] = 1 if env.opening < 0.03 else -1  # the gripper stays as the policy left it
    for name, (axis, sign) in _MOVES.items():
        first, after = held[name]
        expected[first - 6 : after - 6, axis] = 0.3 * sign
    np.testing.assert_allclose(episode.actions[6:30], expected, atol=1e-6)
    by_policy = ~episode.interventions
    np.testing.assert_allclose(episode.actions[by_policy], np.clip(actor.wanted, -1, 1)[by_policy], atol=1e-6)

    positions = np.array(env.positions)
    for name, (axis, sign) in _MOVES.items():
        first, after = held[name]
        moved = positions[after] - positions[first]
        assert sign * moved[axis] > 0.02, (name, moved)
        assert np.abs(np.delete(moved, axis)).max() < 0.5 * abs(moved[axis]), (name, moved)
        if name == "Right":
            assert moved @ axes[:, 0] > 0.02  # as it is seen in the window


def person_corrects(screen, process, log):
    """Waits for the window, begins, takes over, hands back, and says that the task is solved."""

    def wait_for_state(control, timeout_s=60):
        def is_there():
            assert process.poll() is None, log.read_text()[-3000:]
            return state_shown(screen) is control

        wait_for(is_there, timeout_s)

    wait_for_state(Control.PAUSED, timeout_s=300)
    screen.focus(screen.window(_TITLE))
    screen.press("space")
    wait_for_state(Control.POLICY)
    screen.hold("Right")
    screen.press("Tab")
    wait_for_state(Control.PERSON)
    threading.Event().wait(0.7)
    screen.press("Tab")
    screen.let_go("Right")
    wait_for_state(Control.POLICY)
    screen.press("s")


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_playbyear_dagger_learns_from_a_person(screen, tmp_path):
    options = ("--expert.type=teleop", "--num_episodes=1", "--env.episode_length=2000")
    program = "from lerobot_playbyear.scripts.commands import dagger; dagger()"
    command = [sys.executable, "-c", program, *arguments(tmp_path, *options)]
    log = tmp_path / "log.txt"
    with log.open("w") as file:
        process = subprocess.Popen(command, env=screen.environment, stdout=file, stderr=subprocess.STDOUT)
    try:
        person_corrects(screen, process, log)
        assert process.wait(timeout=200) == 0, log.read_text()[-3000:]
    finally:
        process.kill()
        process.wait()

    dataset = corrections(tmp_path)
    flags = column(dataset, "intervention").ravel()
    first, after = np.flatnonzero(np.diff(np.concatenate([[0], flags, [0]])))  # one stretch without gaps
    assert after - first >= 5
    by_person = np.isclose(column(dataset, "action")[:, 0], 0.3)
    assert by_person[first + 2 : after - 2].all()  # both keys go down within two steps, and up
    assert not by_person[~flags].any()
    assert column(dataset, "next.success").ravel()[-1]
    [attempt] = metrics(tmp_path, "attempt")
    assert (attempt["outcome"], attempt["n_frames"]) == ("kept", len(dataset))
    assert metrics(tmp_path, "round")[0]["n_updates"] == 2


def person_demonstrates(screen):
    """Throws the first attempt away and keeps the second one."""
    try:
        demonstrate(screen)
    except BaseException:
        screen.press("Escape")  # or the recording waits for ever
        raise


def demonstrate(screen):
    screen.focus(screen.window(_TITLE))
    for ending in ("r", "s"):
        wait_for(lambda: state_shown(screen) is Control.PAUSED, 60)
        screen.press("space")
        wait_for(lambda: state_shown(screen) is Control.PERSON)
        screen.hold("Up")
        threading.Event().wait(0.6)
        screen.let_go("Up")
        screen.press(ending)
        wait_for(lambda: state_shown(screen) is not Control.PERSON)


def test_playbyear_record_records_a_persons_demonstrations(screen, tmp_path):
    dataset = RecordDatasetConfig("test/person", str(tmp_path / "person"), num_episodes=1)
    env_cfg = env_config(episode_length=2000)
    cfg = RecordConfig(env_cfg, dataset, seed=7, expert=TeleopExpertConfig(play_sound=False))
    person = threading.Thread(target=person_demonstrates, args=(screen,))
    person.start()
    root = record(cfg)
    person.join(timeout=60)
    recorded = LeRobotDataset("test/person", root=root, video_backend="pyav")
    assert recorded.num_episodes == 1
    assert set(column(recorded, "seed").ravel()) == {7}  # the one that was thrown away is done again
    assert column(recorded, "intervention").all()
    assert column(recorded, "next.success").ravel()[-1]
    moved = np.isclose(column(recorded, "action")[:, 1], 0.3)
    assert 2 <= moved.sum() < len(recorded)


def test_a_key_is_let_go_when_the_window_loses_the_keyboard_and_the_window_tells_when_it_is_gone(screen):
    windows = [Window(f"{_TITLE}: {name}") for name in ("first", "second")]
    screen.focus(screen.window("first"))
    screen.hold("space")
    wait_for(lambda: "space" in windows[0].keys._held)
    screen.focus(screen.window("second"))
    wait_for(lambda: "space" not in windows[0].keys._held)
    screen.let_go("space")
    screen.kill_window(screen.window("second"))
    wait_for(lambda: not windows[1].is_open)
    assert windows[0].is_open
    for window in windows:
        window.close()
