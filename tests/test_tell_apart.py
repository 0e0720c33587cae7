"""Screws or peanuts: only sound tells, and what is done after the drop decides."""

import copy

import numpy as np
import pytest
from support.playing import Still, finish, make

from gym_playbyear.experts.blind import BlindPouch
from gym_playbyear.tasks.tell_apart import CONTENTS, HALF_SIZE, PIECES

TASK, OPEN, CLOSE = "TellApart-v1", -1.0, 1.0


def go(env, height: float, grip: float, n_steps: int) -> dict:
    """Moves the hand over the pouch, so high above the table [m]."""
    for _ in range(n_steps):
        way = [*env.position("pouch")[:2], 0.8 + height] - env.eef_position
        _, _, _, info = env.step_physics(np.append(np.clip(way / 0.05, -0.7, 0.7), grip))
    return info


def level(wave: np.ndarray) -> float:
    """Between 1 and 4 kHz [dB re full scale]."""
    spectrum = np.abs(np.fft.rfft(wave / 32768 * np.hanning(len(wave)))) ** 2
    hertz = np.fft.rfftfreq(len(wave), 1 / 16000)
    return float(10 * np.log10(spectrum[(hertz > 1000) & (hertz < 4000)].sum() / len(wave) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["lift", "leave"])
def test_without_sound_every_observation_is_the_same_byte_for_byte(strategy):
    """Until the end, whatever is done; how it ends is all that differs."""
    worlds = [make(TASK, image_size=48), make(TASK, image_size=48)]
    seen = [
        env.reset(seed=4, options={"contents": contents})[0] for env, contents in zip(worlds, CONTENTS, strict=True)
    ]
    script, n_steps, ended = BlindPouch(worlds[0], strategy), 0, [False, False]
    while not any(ended):
        assert seen[0].keys() == seen[1].keys() == {"pixels", "agent_pos"}
        assert seen[0]["pixels"]["front"].tobytes() == seen[1]["pixels"]["front"].tobytes()
        assert seen[0]["agent_pos"].tobytes() == seen[1]["agent_pos"].tobytes()
        shown = [env.camera_numbers() for env in worlds]
        for name in shown[0]:
            np.testing.assert_array_equal(shown[0][name], shown[1][name])
        action = script.act()
        outcomes = [env.step(action) for env in worlds]
        seen, ended = [outcome[0] for outcome in outcomes], [outcome[2] for outcome in outcomes]
        n_steps += 1
        if not any(ended):
            assert outcomes[0][1:] == outcomes[1][1:] == (0.0, False, False, {"is_success": False})
    assert seen[0]["pixels"]["front"].tobytes() == seen[1]["pixels"]["front"].tobytes()
    assert n_steps > 30


def test_only_the_rattle_differs():
    """Nothing before the hand is at the pouch; after the drop screws are louder than peanuts where metal rings."""
    heard = []
    for contents in CONTENTS:
        env = make(TASK, sound="waveform")
        blocks = [env.reset(seed=7, options={"contents": contents})[0]["audio.gripper"]]
        expert, touched_at, dropped_at = env.scripted_expert(), 0, 0
        while expert.phase not in ("leave", "rest") and not (expert.was_dropped and expert.phase == "approach"):
            blocks.append(env.step(expert.act())[0]["audio.gripper"])
            touched_at = touched_at or (len(blocks) - 1) * (env.contact_forces["gripper-pouch"] > 0)
            dropped_at = dropped_at or (len(blocks) - 1) * expert.was_dropped
        heard.append((blocks, touched_at, dropped_at))
    (screws, touched_at, dropped_at), (peanuts, *others) = heard
    assert others == [touched_at, dropped_at]
    assert 5 < touched_at < dropped_at
    for one, other in zip(screws[:touched_at], peanuts[:touched_at], strict=True):
        np.testing.assert_array_equal(one, other)
    # The hand's release is loud itself: what follows it tells.
    after = [
        max(level(part) for part in np.concatenate(b[dropped_at + 1 :]).reshape(-1, 800)[4:]) for b in (screws, peanuts)
    ]
    assert after[0] > after[1] + 6


@pytest.mark.parametrize("contents", CONTENTS)
def test_the_expert_lifts_screws_and_leaves_peanuts(contents):
    env = make(TASK)
    env.reset_physics(seed=0, options={"contents": contents})
    expert = env.scripted_expert()
    assert finish(env, expert) == {"is_success": True, "end": "success", "contents": contents, "acted_early": False}
    assert expert.phase == {"screws": "keep", "peanuts": "rest"}[contents]


@pytest.mark.parametrize("contents", CONTENTS)
def test_what_is_done_after_the_drop_decides(contents):
    """A copy of the episode does the other thing; nothing of it reaches the original."""
    env = make(TASK, contents=contents)
    env.reset_physics(seed=1)
    script = env.blind_baselines()["lift"]
    while not script.was_dropped:
        env.step_physics(script.act())
    other, other_script = copy.deepcopy((env, script))
    other_script.strategy = "leave"
    ends = {one.strategy: finish(world, one) for world, one in ((other, other_script), (env, script))}
    right, wrong = {"screws": ("lift", "leave"), "peanuts": ("leave", "lift")}[contents]
    assert ends[right] == {"is_success": True, "end": "success", "contents": contents, "acted_early": False}
    assert ends[wrong] == {"is_success": False, "end": "wrong", "contents": contents, "acted_early": False}


def test_a_pouch_that_is_set_down_or_left_where_it_was_was_not_dropped():
    env = make(TASK, contents="peanuts", horizon=30)
    env.reset_physics(seed=0)
    assert finish(env, Still())["end"] == "time"
    env = make(TASK, contents="peanuts")
    env.reset_physics(seed=0)
    for height, grip, n_steps in ((0.1, OPEN, 10), (0.024, OPEN, 5), (0.024, CLOSE, 4), (0.1, CLOSE, 8)):
        go(env, height, grip, n_steps)
    assert env.position("pouch")[2] > 0.86
    for height, grip, n_steps in ((0.024, CLOSE, 6), (0.024, OPEN, 5), (0.24, OPEN, 20)):
        info = go(env, height, grip, n_steps)
    assert env.position("pouch")[2] < 0.83
    assert info == {"is_success": False}


def test_the_pieces_stay_inside_when_the_pouch_is_shaken_and_dropped():
    env, rng = make(TASK), np.random.default_rng(0)
    env.reset_physics(seed=2)
    expert = env.scripted_expert()
    while expert.phase != "carry":
        env.step_physics(expert.act())
    for step in range(30):
        env.step_physics(np.append(rng.choice([-1.0, 1.0], 3), CLOSE if step < 20 else OPEN))
    for name in PIECES:
        offset = env.data.body("pouch").xmat.reshape(3, 3).T @ (env.position(name) - env.position("pouch"))
        assert (np.abs(offset) < HALF_SIZE).all()


def test_what_is_in_it_is_a_coin_toss_that_changes_nothing_else():
    env = make(TASK)
    drawn, places = [], []
    for options in ({}, {"contents": "screws"}, {"contents": "peanuts"}):
        for seed in range(200):
            env._np_random = np.random.default_rng(seed)
            env.definition.initialize_episode(env, options)
            drawn.append(env.secrets["contents"])
            places.append((*env.position("pouch")[:2], env.np_random.integers(2**63)))
    assert 80 < drawn[:200].count("screws") < 120
    assert set(drawn[200:400]) == {"screws"}
    assert places[:200] == places[200:400] == places[400:]
