"""Where the hand comes down is told of hops that did end, and the expert's end above the cube."""

import pytest

from experiments.landings import FALL_M, HopRecorder, Landing
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.play import play
from lerobot_playbyear.episodes.script import Script


@pytest.fixture
def recorder():
    env = HopRecorder(env_spec(PlaybyearEnvConfig(task="OccludedPickPlace-v1", sound="none")).make())
    yield env
    env.close()


def test_the_experts_hand_comes_down_above_the_cube(recorder):
    play(recorder, Script(), 50000)
    landing = recorder.landing()
    assert recorder.end == "success"
    assert landing is not None
    assert abs(landing.offset_mm) < 5
    assert landing.way_mm > 20
    assert landing.n_steps > 5


def test_a_hop_that_missed_is_told_with_its_side_and_length(recorder):
    steps = [
        (0.10, 0.82, 0.15, 0.0),
        (0.13, 0.82, 0.15, 1.0),
        (0.15, 0.90, 0.15, 0.0),
        (0.18, 0.89 - FALL_M, 0.15, 0.0),
    ]
    recorder._steps = steps
    assert recorder.landing() == Landing(pytest.approx(30), pytest.approx(50), 2)
    recorder._steps = steps[:3]
    assert recorder.landing() is None
    recorder._steps = [(y, z, cube_y, 0.0) for y, z, cube_y, _ in steps]
    assert recorder.landing() is None
