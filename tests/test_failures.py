"""A failure is told by what went wrong first, not by how the episode ended."""

from collections import Counter

import numpy as np
import pytest

from experiments.failures import FailureRecorder, Onlooker, table_of
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.script import Script

SEED = 50000


@pytest.fixture
def recorder():
    env = FailureRecorder(env_spec(PlaybyearEnvConfig(task="OccludedPickPlace-v1", sound="none")).make())
    yield env
    env.close()


class Altered:
    """The script, whose actions are altered from the step on in which it carries the cube."""

    def __init__(self, alter, phase="carry"):
        self.alter, self.phase = alter, phase

    def reset(self, env):
        self.script, self.seen = env.unwrapped.scripted_expert(), 0

    def act(self, observation):
        action = self.script.act()
        self.seen += self.script.phase == self.phase
        return self.alter(action, self.seen) if self.seen else action


def mistake_of(recorder, actor):
    onlooker = Onlooker()
    play(recorder, actor, SEED, expert=onlooker)
    return recorder.first_mistake(), onlooker.reason


def test_the_expert_makes_no_mistake_and_lets_go_over_the_tray(recorder):
    assert mistake_of(recorder, Script()) == ("", "nothing")
    assert abs(recorder.let_go()) < 12


def test_a_cube_that_is_let_go_on_the_way_was_put_down_beside_the_tray(recorder):
    opens = lambda action, seen: np.array([0, -0.03, 0, -1.0], np.float32) if seen > 3 else action  # noqa: E731
    assert mistake_of(recorder, Altered(opens)) == ("put down beside the tray", "opens")
    assert recorder.let_go() < -50
    assert recorder.end != "success"


def test_a_hand_that_never_comes_down_touched_and_did_not_lift(recorder):
    up = lambda action, seen: np.array([0, 0, 0, -1.0], np.float32)  # noqa: E731
    assert mistake_of(recorder, Altered(up, "hover"))[0] == "touched, and not lifted"


def test_a_hand_that_stands_still_never_touched(recorder):
    still = lambda action, seen: np.array([0, 0, 0, -1.0], np.float32)  # noqa: E731
    assert mistake_of(recorder, Altered(still, "approach")) == ("never touched", "still")


def test_the_table_begins_with_the_most_frequent():
    rows = table_of({"": Counter(nothing=3), "never touched": Counter(still=4, late=1)}, 8).splitlines()
    assert rows[2:] == ["| never touched | 5 of 8 | 4 still, 1 late |", "| none: success | 3 of 8 | 3 nothing |"]
