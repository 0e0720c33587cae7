"""How an attempt failed, told from the simulator's state: each mode by a hand that fails in this way and in no other."""

import json
from typing import Any

import numpy as np
import pytest
from support.playing import STILL, make

from gym_playbyear.failures import (
    DROPPED,
    FALSE_GRASP,
    MODES,
    NO_CONTACT,
    NO_GRASP,
    NO_LIFT,
    NO_SEARCH,
    OUTSIDE,
    FailureMode,
)
from lerobot_env_playbyear.attempts import AttemptsFile

CLOSE = np.array([0.0, 0.0, 0.0, 1.0])


def failed(task: str, act: Any, seed: int = 50000, n_steps: int = 150) -> str:
    """The mode of an attempt.

    Args:
        task: Its name.
        act: `act(env, expert, step)` gives the action.
        seed: Of the episode.
        n_steps: After which time is up.
    """
    env = make(task, horizon=n_steps)
    env.reset_physics(seed=seed)
    watch, expert, info = FailureMode(env), env.scripted_expert(), {}
    for step in range(n_steps):
        _, terminated, truncated, info = env.step_physics(act(env, expert, step))
        watch.look(env)
        if terminated or truncated:
            break
    assert not info["is_success"]
    return watch.told(env, info["end"])


def stays(env, expert, step):
    return STILL


def closes(env, expert, step):
    """Where nothing is."""
    return CLOSE


def sweeps_above(env, expert, step):
    """As low as the cube, and away from it."""
    away = -1.0 if env.position("cube")[1] > env.eef_position[1] else 1.0
    down = -1.0 if env.eef_position[2] > 0.85 else 0.0
    return np.array([0.0, 0.1 * away, 0.2 * down, -1.0])


def touches(env, expert, step):
    """Stops when it touches."""
    has_touched = touches.touched = touches.touched or env.contact_forces["gripper-cube"] > 0.2
    return STILL if has_touched else expert.act()


def holds(env, expert, step):
    """Closes as the expert does, and never lifts."""
    action = expert.act()
    return np.append(np.minimum(action[:3], 0.0) if action[3] > 0 else action[:3], action[3])


def lets_go(env, expert, step):
    """As soon as the cube is high, far from any tray."""
    lets_go.is_up = lets_go.is_up or env.position("cube")[2] > lets_go.z + 0.03
    return STILL if lets_go.is_up else expert.act()


def lets_go_beside(env, expert, step):
    """Carries the cube to the tray, and lets it fall beside it."""
    aside = abs(env.position("cube")[1] - env.shown["bin_position"][1])
    is_up = env.position("cube")[2] > lets_go.z + 0.03
    lets_go_beside.is_there = lets_go_beside.is_there or (is_up and 0.06 < aside < 0.09)
    return STILL if lets_go_beside.is_there else expert.act()


@pytest.mark.parametrize(
    ("mode", "task", "act"),
    [
        (NO_SEARCH, "OccludedGrasp-v1", stays),
        (NO_CONTACT, "OccludedGrasp-v1", sweeps_above),
        (NO_GRASP, "OccludedGrasp-v1", touches),
        (FALSE_GRASP, "OccludedGrasp-v1", closes),
        (NO_LIFT, "OccludedGrasp-v1", holds),
        (DROPPED, "OccludedPickPlace-v1", lets_go),
        (OUTSIDE, "OccludedPickPlace-v1", lets_go_beside),
        (FALSE_GRASP, "KeyBag-Easy-v1", closes),
    ],
)
def test_each_way_to_fail_has_its_name(mode, task, act):
    touches.touched = lets_go.is_up = lets_go_beside.is_there = False
    lets_go.z = 0.82
    assert mode in MODES
    assert failed(task, act, n_steps=300) == mode


def test_a_file_of_attempts_tells_the_mode_of_failures_alone(tmp_path):
    env = AttemptsFile(make("OccludedGrasp-v1", horizon=150), str(tmp_path / "attempts.jsonl"))
    for acts in (True, False):
        env.reset(seed=50000)
        expert, done = env.unwrapped.scripted_expert(), False
        while not done:
            _, _, terminated, truncated, _ = env.step(expert.act() if acts else STILL)
            done = terminated or truncated
    solved, failed = map(json.loads, (tmp_path / "attempts.jsonl").read_text().splitlines())
    assert solved["is_success"]
    assert "failure" not in solved
    assert failed["failure"] == NO_SEARCH
