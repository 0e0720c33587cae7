"""How people see the tasks: the same motion with other shapes and light; physics and the policy see none of it."""

from functools import partial

import numpy as np
import pytest
from support import playing

from gym_playbyear.rendering import PeopleView

make = partial(playing.make, render_mode="rgb_array", render_size=120)
TASKS = ("OccludedGrasp-v1", "OccludedPickPlace-v1", "TellApart-v1", "KeyBag-Hard-v1")


@pytest.mark.parametrize("task", TASKS)
def test_everything_is_seen_where_it_is(task):
    env = make(task)
    stage = PeopleView(env.definition, 64)
    for seed in (0, 1):
        env.reset_physics(seed=seed)
        expert = env.scripted_expert()
        for _ in range(15):
            env.step_physics(expert.act())
        stage.follow(env.model, env.data)
        np.testing.assert_array_equal(stage.data.xpos, env.data.xpos)
        np.testing.assert_array_equal(stage.data.xquat, env.data.xquat)


def test_who_watches_changes_nothing():
    def episode(watches: bool) -> bytes:
        env = make("OccludedGrasp-v1", image_size=24, sound="waveform")
        seen, rng = [env.reset(seed=4)[0]], np.random.default_rng(0)
        for _ in range(12):
            if watches:
                env.render()
            seen.append(env.step(rng.uniform(-1, 1, 4))[0])
        state = env.data.qpos.tobytes() + env.data.qvel.tobytes()
        env.close()
        return state + b"".join(o["pixels"]["front"].tobytes() + o["audio.gripper"].tobytes() for o in seen)

    assert episode(True) == episode(False)


def test_what_moved_is_drawn_again_and_what_did_not_is_the_same():
    env = make("OccludedGrasp-v1")
    env.reset_physics(seed=0)
    first = env.render()
    first[:] = 0  # a caller's own
    again = env.render()
    assert again.any()
    np.testing.assert_array_equal(env.render(), again)
    env.step_physics(np.array([0, 1, 0, -1]))
    assert (env.render() != again).any()
    env.reset_physics(seed=0, options={"cube_position": (0.0, -0.2)})
    assert (env.render() != again).any()
    env.close()


def red(picture: np.ndarray) -> int:
    r, g, b = picture.astype(int).transpose(2, 0, 1)
    return int(((r > 1.8 * g) & (r > 1.8 * b) & (r > 60)).sum())


def test_people_see_the_cube_behind_the_wall_unless_it_is_not_there():
    for hidden_object, is_seen in ((True, True), (False, False)):
        env = make("OccludedGrasp-v1", hidden_object=hidden_object)
        env.reset_physics(seed=0, options={"cube_position": (0.0, -0.2)})
        assert (red(env.render()) > 10) == is_seen
        env.close()
