"""Tasks put together from parts: what follows from the parts, rates of their own, two loose things, and what is refused."""

import pickle
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from support.playing import STILL

from gym_playbyear.environment import TaskEnv
from gym_playbyear.registry import make_definition
from gym_playbyear.task import Prop, Task
from gym_playbyear.tasks.arena import TABLE_TOP, loose_box
from gym_playbyear.terminations import EarlyAction, Success


def never(env) -> bool:
    return False


def put_on_table(env, options) -> dict:
    for number, prop in enumerate(prop for prop in env.definition.props if prop.loose):
        env.set_pose(prop.name, (0.0, 0.1, TABLE_TOP + 0.03 + 0.05 * number), yaw=0.0)
    return {}


def block(name: str) -> Prop:
    return loose_box(name, (0.02,) * 3, density=1000, friction=0.4, rgba="1 0 0 1", material="cube")


def task(*props: Prop, **traits) -> Task:
    """A table with some things on it."""
    cube_task = make_definition("OccludedGrasp-v1", {})
    return replace(
        cube_task,
        props=props,
        initialize_episode=put_on_table,
        success=Success(never),
        terminations=(),
        force_proxy_of=None,
        early_action=EarlyAction(),
        **traits,
    )


@pytest.mark.parametrize("bits", ["", 'contype="2" conaffinity="3"'])
def test_loose_things_may_lie_on_each_other(bits):
    body = '<body name="{0}"><freejoint name="{0}"/><geom type="box" size=".02 .02 .02" mass=".1" {1}/></body>'
    env = TaskEnv(task(*(Prop(name, body.format(name, bits), "cube", loose=True) for name in "ab")), sound="none")
    env.reset_physics(seed=0)
    for _ in range(10):
        env.step_physics(STILL)
    assert env.position("b")[2] > env.position("a")[2] + 0.035
    assert env.contact_forces["a-b"] > 0.5


def test_a_prop_may_be_an_mjspec():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="ball")
    body.add_freejoint(name="ball")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], density=500)
    env = pickle.loads(pickle.dumps(TaskEnv(task(Prop("ball", spec, "cube", loose=True)), sound="none")))
    env.reset_physics(seed=0)
    for _ in range(10):
        env.step_physics(STILL)
    assert env.position("ball")[2] == pytest.approx(TABLE_TOP + 0.02, abs=0.002)


@pytest.mark.parametrize(
    ("prop", "message"),
    [
        (Prop("a", '<body name="b"><geom size=".1"/></body>', "cube"), "no body of that name"),
        (Prop("a", '<body name="a"><geom size=".1"/></body>', "cube", loose=True), "no <freejoint"),
    ],
)
def test_a_prop_that_lacks_its_name_is_refused(prop, message):
    with pytest.raises(ValueError, match=message):
        TaskEnv(task(prop), sound="none")


WALL = '<body name="wall"><geom name="wall" type="box" size="0.01 0.1 0.1" pos="0 0 0.9"/></body>'


def turn_the_wall_at_times(env, options) -> dict:
    if env.np_random.random() < 0.5:
        env.set_pose("wall", (0.1, 0.0, 0.0), yaw=0.5)
    return {}


def test_no_episode_depends_on_the_one_before():
    made = replace(task(block("a"), Prop("wall", WALL, "table")), initialize_episode=turn_the_wall_at_times)
    worn, scenes = TaskEnv(made, sound="none"), set()
    for seed in range(6):
        worn.reset_physics(seed=seed)
        fresh = TaskEnv(made, sound="none")
        fresh.reset_physics(seed=seed)
        np.testing.assert_array_equal(worn.model.body_pos, fresh.model.body_pos)
        np.testing.assert_array_equal(worn.model.body_quat, fresh.model.body_quat)
        np.testing.assert_array_equal(worn.data.qpos, fresh.data.qpos)
        scenes.add(float(worn.model.body("wall").quat[0]))
    assert len(scenes) == 2
