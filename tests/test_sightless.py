"""Scripts that feel contact and do not see: what they are told, and that they are bound by it."""

import gymnasium as gym
import numpy as np
import pytest

from experiments.sightless import SCRIPTS, Mistold, attempts


def test_a_script_that_cannot_see_is_told_nothing_of_its_own_episode():
    env = gym.make("gym_playbyear/OccludedPickPlace-v1", sound="none").unwrapped
    for script in SCRIPTS.values():
        told = []
        for seed in (11, 12):
            env.begin_episode(seed=seed)
            told.append(script(env, np.random.default_rng(3)))
            env.begin_episode(seed=seed)
            mistold = Mistold(env, told[-1])
            assert not np.array_equal(mistold.bin_position, env.bin_position)
            np.testing.assert_array_equal(mistold.cube_position, env.cube_position)
        np.testing.assert_array_equal(told[0]["bin_position"], told[1]["bin_position"])
    env.close()


def test_the_half_of_the_table_is_guessed_or_not_told_at_all():
    env = gym.make("gym_playbyear/OccludedGrasp-v1", sound="none").unwrapped
    halves = {"guess": set(), "everywhere": set()}
    for seed in range(20, 26):
        for name, script in SCRIPTS.items():
            env.begin_episode(seed=seed)
            halves[name].add(tuple(script(env, np.random.default_rng(5))["hidden_range"]))
    assert len(halves["guess"]) == 1  # the same draw, whatever the episode is
    assert halves["everywhere"] == {tuple(env.variant.cube_y)}
    env.close()


@pytest.mark.slow
def test_half_of_the_table_can_be_searched_without_seeing_which_one_and_the_tray_cannot():
    seeds = range(300, 312)
    assert attempts("OccludedGrasp-v1", "everywhere", seeds).count("success") >= 11
    assert attempts("OccludedGrasp-v1", "guess", seeds).count("success") <= 9
    assert attempts("OccludedPickPlace-v1", "everywhere", seeds).count("success") <= 9


def test_a_mistold_environment_lacks_what_the_true_one_lacks():
    env = gym.make("gym_playbyear/OccludedGrasp-v1", sound="none").unwrapped
    env.begin_episode(seed=1)
    with pytest.raises(AttributeError):
        _ = Mistold(env, {}).bin_position
    env.close()
