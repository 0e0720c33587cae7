"""The adversaries of tasks without a cube: bags and pouches, their twin worlds, their scripts, the same tasks in numbers."""

import gc
import json
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from experiments import adversary_table
from experiments.protocol import save
from gym_playbyear.adversaries.groping import GROPES, DepthBelief
from gym_playbyear.adversaries.numeric_env import N_HEARD, N_PLAYER, NumericTask
from gym_playbyear.adversaries.players import deaf_scripts, players
from gym_playbyear.adversaries.scripts import play
from gym_playbyear.adversaries.twin import twin_test
from gym_playbyear.adversaries.view import DeafTask
from gym_playbyear.bag_experts import finger_forces
from gym_playbyear.check import check
from gym_playbyear.proprioception import Proprioception, SensorNoise

EASY, HARD, POUCH = "KeyBag-Easy-v1", "KeyBag-Hard-v1", "TellApart-v1"


def test_every_task_has_players():
    assert {name for name, kind in players(EASY).items() if kind == "deaf"} == set(GROPES)
    assert players(POUCH) == {"expert": "expert", "lift": "blind", "leave": "blind", "coin": "blind"}


@pytest.mark.slow
def test_twin_bags_are_the_same_until_the_touch_and_hard_to_tell_apart_after_it():
    result = twin_test(HARD, range(60000, 60006), n_pictured=1)
    assert result.can_be_touched
    assert result.equal_until_touch, result.first_difference
    assert all(spread.value <= 0.6 for spread in result.auc.values())


@pytest.mark.slow
def test_twin_pouches_are_the_same_to_the_end():
    result = twin_test(POUCH, range(60000, 60004), n_pictured=1)
    assert not result.can_be_touched
    assert result.n_episodes == 4
    assert result.equal_until_touch, result.first_difference
    assert result.pictures_after_touch == 0
    assert all(spread.value == 0.5 for spread in result.auc.values())


def test_twins_that_differ_are_found_out(monkeypatch):
    """Peanuts that weigh less than screws: the arm's measurements tell."""
    begin = DeafTask.begin

    def lighter(self, seed, **options):
        view = begin(self, seed, **options)
        if self.env.contents == "peanuts":
            self.env.data.qvel[-6:] += 0.3
        return view

    monkeypatch.setattr(DeafTask, "begin", lighter)
    result = twin_test(POUCH, range(60000, 60004), n_pictured=0, horizon=15)
    assert not result.equal_until_touch


def test_a_script_in_a_bag_cannot_reach_what_is_behind_the_scenes():
    task = DeafTask(HARD)
    view = task.begin(0)
    script = deaf_scripts(task)["feel"](task.facts, np.random.default_rng(0))
    for _ in range(6):
        view, _, _ = task.advance(script.act(view))
    waiting, seen = [script, view, task.facts], {}
    while waiting:
        current = waiting.pop()
        if id(current) in seen or isinstance(current, type | type(gc) | type(play)):
            continue
        seen[id(current)] = current
        waiting += gc.get_referents(current)
    behind = (gym.Env, DeafTask, mujoco.MjData, mujoco.MjModel)
    assert not [found for found in seen.values() if isinstance(found, behind)]
    task.close()


def test_a_script_that_knows_how_deep_the_keys_lie_takes_them_out():
    task = DeafTask(EASY)
    maker = deaf_scripts(task)["feel"]

    def told(facts, rng):
        script = maker(facts, rng)
        script.bottom = (0.058, 0.062)
        return script

    assert sum(play(task, told, seed, bottom=0.06).success for seed in range(4)) >= 2
    task.close()


def test_a_belief_finds_what_presses_back_unless_the_hands_error_wanders():
    def error(wander: float) -> float:
        """How far off the believed height of the bottom is, on average [m]."""
        sensors, rng, errors = SensorNoise(wander=wander), np.random.default_rng(0), []
        for number in range(60):
            bottom = rng.uniform(0.035, 0.09)
            belief = DepthBelief(0.025, 0.10, 0.9, sensors, 5)
            arm = Proprioception(sensors, 5, np.random.default_rng(number))
            tips = np.arange(0.125, bottom - 0.006, -0.003)
            for height in tips:
                lag = 0.0003 + 0.022 * max(0.0, bottom + 0.012 - height)
                belief.update(height, float(arm.measure(np.array([0, 0, lag, 0, 0, 0, 0]), rng)[2]))
            errors.append(abs(belief.best() - bottom))
        return float(np.mean(errors))

    assert error(0.0) < 0.75 * error(0.001)


def test_a_wandering_error_wanders_and_draws_nothing_of_the_usual_numbers():
    noise = SensorNoise()
    assert noise.wander == 0
    plain = Proprioception(noise, 5)
    wandering = Proprioception(replace(noise, wander=0.0006), 5, np.random.default_rng(1))
    streams = np.random.default_rng(0), np.random.default_rng(0)
    true = np.array([0.5, 0, 0.2, 0.02, 0.02, 0, 0])
    errors = []
    for _ in range(4000):
        usual, off = plain.measure(true, streams[0]), wandering.measure(true, streams[1])
        np.testing.assert_array_equal(usual[3:], off[3:])
        errors.append(off[:3] - usual[:3])
    assert 0.0005 < np.std(errors) < 0.0007
    series = np.array(errors)[:, 2]
    kept = np.corrcoef(series[:-1], series[1:])[0, 1]
    assert np.exp(-0.1) - 0.06 < kept < np.exp(-0.1) + 0.04


def test_the_wandering_error_is_the_episodes_own():
    env = gym.make(f"gym_playbyear:gym_playbyear/{EASY}", sound="none", image_size=8).unwrapped
    first = env.reset(seed=5)[0]["agent_pos"]
    second = env.reset()[0]["agent_pos"]
    np.testing.assert_array_equal(first, env.reset(seed=5)[0]["agent_pos"])
    np.testing.assert_array_equal(second, env.reset()[0]["agent_pos"])
    env.close()


@pytest.mark.parametrize(("name", "options"), [(EASY, {}), (POUCH, {"contents": "screws"})])
def test_other_tasks_in_numbers(name, options):
    env = NumericTask(name, hears=True, **options)
    assert env.repeat == 1
    observation, _ = env.reset(seed=1)
    expert = env.task.env.scripted_expert()
    heard, worth, earned, done = np.zeros(N_HEARD), [], 0.0, False
    while not done:
        assert env.observation_space.contains(observation)
        env.begin_action()
        control = expert.act()
        done, info = env.advance(control)
        earned += env.reward(done, info)
        observation = env.end_action(control)
        heard = np.maximum(heard, observation[N_PLAYER - N_HEARD : N_PLAYER])
        env.hears = False
        assert not env.end_action(control)[N_PLAYER - N_HEARD : N_PLAYER].any()
        env.hears = True
        worth.append(env._potential)
    assert info["is_success"]
    assert earned > 1
    assert max(worth) > worth[0] + 3
    assert heard[[0, 2, 3]].all()


def test_who_hears_a_bag_with_two_ears_hears_which_finger_touched():
    env = NumericTask("KeyBag-Hard-v1", hears=True)
    sides = set()
    for seed in range(6):
        env.reset(seed=seed)
        expert = env.task.env.scripted_expert()
        while True:
            env.begin_action()
            control = expert.act()
            done, _ = env.advance(control)
            told = env.end_action(control)[N_PLAYER - N_HEARD + 2]
            if told or done:
                break
        sides.add(float(np.sign(told)))
        left, right = finger_forces(env.task.env)
        assert (told > 0) == (right > left)
    assert sides == {-1.0, 1.0}


def test_peanuts_are_not_heard_and_screws_are():
    loudest = {}
    for contents in ("screws", "peanuts"):
        env = NumericTask(POUCH, hears=True, contents=contents)
        env.reset(seed=1)
        expert, rattle = env.task.env.scripted_expert(), 0.0
        for _ in range(25):
            env.advance(expert.act())
            rattle = max(rattle, env.terms.heard()[0])
        loudest[contents] = rattle
    assert loudest["peanuts"] == 0
    assert loudest["screws"] > 0.2


# The check


def test_a_check_that_was_stopped_goes_on_with_the_next_player(tmp_path):
    file = tmp_path / "check.partial"
    settings = {"first_seed": 1000, "twin": False, "progress": file}
    first = check("OccludedGrasp-v1", 1, names=["middle"], **settings)
    kept = json.loads(file.read_text())
    kept["played"]["middle"][0]["end"] = "as it was kept"
    file.write_text(json.dumps(kept))
    both = check("OccludedGrasp-v1", 1, names=["middle", "push"], **settings)
    assert [row.ends for row in both.rows] == [{"as it was kept": 1}, {"shoved": 1}]
    other = check("OccludedGrasp-v1", 2, names=["middle"], **settings)
    assert "as it was kept" not in other.rows[0].ends
    assert first.rows[0].ends != both.rows[0].ends


def test_a_learners_result_on_another_task_is_refused():
    learned = [{"name": "rl", "task": "OccludedGrasp-v0", "hears": False, "successes": 1, "n_episodes": 10}]
    with pytest.raises(ValueError, match="'rl' is no learner's result on 'OccludedGrasp-v1'"):
        check("OccludedGrasp-v1", 1, names=["push"], twin=False, learned=learned)


# The committed table


def test_the_committed_table_is_what_the_results_say():
    page = adversary_table.PAGE.read_text()
    assert adversary_table.with_table(page, adversary_table.table()) == page, (
        "run `python -m experiments.adversary_table`"
    )


def test_a_table_says_what_was_not_run(tmp_path):
    made = adversary_table.table(tmp_path)
    assert made.splitlines()[2] == "| episodes |" + " not run |" * len(adversary_table.checks())
    save(
        tmp_path / f"{EASY}-deaf-expert-seed1.json",
        {"successes": 3, "n_episodes": 10, "steps": 2_000_000, "options": {"teacher": "expert"}},
    )
    line = next(line for line in adversary_table.table(tmp_path).splitlines() if line.startswith("| learned, deaf"))
    assert "30 % (2,000k steps)" in line
    with pytest.raises(ValueError, match="has no lines"):
        adversary_table.with_table("a page", made)


def test_a_table_shows_which_learner_breaks_the_tasks_claim(tmp_path):
    rows = [{"name": "straight", "kind": "blind", "successes": 1, "n_episodes": 10}]
    check = {"rows": rows, "limits": {"deaf_margin": 0.1}}
    shown = {}
    for sense in ("deaf", "hears"):
        for successes in (2, 3):
            result = {"successes": successes, "n_episodes": 10, "steps": 5000, "options": {"teacher": "expert"}}
            save(tmp_path / f"{EASY}-{sense}-expert-seed1.json", result)
            shown[sense, successes] = adversary_table.learned(EASY, sense, check, tmp_path)
    assert shown["deaf", 2] == shown["hears", 3].replace("30", "20") == "20 % (5k steps)"
    assert shown["deaf", 3] == shown["hears", 2].replace("20", "30") == "**30 %** (5k steps)"
