"""The adversaries: what they may see, what they can do, and how a task is judged by them."""

import gc
import json
import sys
import types
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from gym_playbyear.adversaries.belief import CubeBelief
from gym_playbyear.adversaries.classifier import CLASSIFIERS, area_under_curve
from gym_playbyear.adversaries.numeric_env import N_PLAYER, NumericTask
from gym_playbyear.adversaries.players import outcomes, players
from gym_playbyear.adversaries.scripts import SCRIPTS, play
from gym_playbyear.adversaries.twin import twin_test
from gym_playbyear.adversaries.view import DeafTask
from gym_playbyear.check import Limits, Row, as_text, check, judge, main
from gym_playbyear.options import make_definition

GRASP, PICK_PLACE = "OccludedGrasp-v0", "OccludedPickPlace-v0"


def reachable(root: object) -> list[object]:
    """Every object that can be reached from this one, but for code and what code has at hand anyway."""
    code = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.CodeType)
    seen: dict[int, object] = {}
    waiting = [root]
    while waiting:
        current = waiting.pop()
        if id(current) in seen or isinstance(current, code):
            continue
        seen[id(current)] = current
        waiting += gc.get_referents(current)
    return list(seen.values())


@pytest.mark.parametrize("name", SCRIPTS)
def test_no_script_can_reach_what_is_behind_the_scenes(name):
    task = DeafTask(GRASP)
    view = task.begin(0)
    script = SCRIPTS[name](task.facts, np.random.default_rng(0))
    for _ in range(12):
        view, _, _ = task.advance(script.act(view))
    behind = (gym.Env, DeafTask, mujoco.MjData, mujoco.MjModel)
    assert not [found for found in reachable([script, view, task.facts]) if isinstance(found, behind)]
    assert any(isinstance(found, mujoco.MjData) for found in reachable(task)), "the search itself finds what there is"
    task.close()


def test_a_deaf_view_is_what_the_policy_observes():
    env = gym.make(f"gym_playbyear:gym_playbyear/{PICK_PLACE}", sound="none", variant="paper", image_size=8).unwrapped
    task = DeafTask(PICK_PLACE, variant="paper")  # without sensor noise, so that both are the same numbers
    observation, _ = env.reset(seed=3)
    view = task.begin(3)
    rng = np.random.default_rng(0)
    for _ in range(8):
        np.testing.assert_array_equal(view.agent_pos, observation["agent_pos"])
        action = rng.uniform(-0.3, 0.3, 4)
        observation, (view, _, _) = env.step(action)[0], task.advance(action)
    np.testing.assert_array_equal(view.shown["bin_position"], env.bin_position)
    env.close()
    task.close()


def test_a_deaf_view_has_the_noise_of_the_sensors():
    task = DeafTask(GRASP)
    task.begin(0)
    hold = np.array([0, 0, 0, -1.0])
    heights = [task.advance(hold)[0].agent_pos[2] for _ in range(60)]
    assert 0.0002 < np.std(heights) < 0.0005
    assert task.begin(4).agent_pos.tolist() == task.begin(4).agent_pos.tolist()
    task.close()


def test_taps_narrow_down_where_the_cube_is():
    belief = CubeBelief(0.0, 0.14)
    for hand, was_blocked in ((0.10, True), (0.14, True), (0.045, False)):
        belief.update(hand, 0.054, was_blocked)
    # A finger 32 mm to either side of the hand rests on it: between 0.10 and 0.14, since 0.045 would have met it elsewhere.
    places = belief.places[belief.probability.sum(axis=1) > 0.01]
    assert 0.104 < places.min() < places.max() < 0.136
    far, between = belief.information(np.array([0.0, 0.12]), 0.054)
    assert far < 0.05
    assert between > 0.3


def test_a_tapping_script_solves_the_first_version_of_the_task():
    task = DeafTask(GRASP)
    assert sum(play(task, SCRIPTS["tap_fast"], seed).success for seed in range(5)) >= 4
    task.close()


def test_a_nudge_shoves_a_near_cube_to_where_it_grasps():
    task = DeafTask(GRASP)
    assert play(task, SCRIPTS["nudge"], 2, cube_position=(0.0, 0.02)).success
    task.close()


def test_scripts_place_what_they_hold_into_the_tray():
    task = DeafTask(PICK_PLACE)
    assert play(task, SCRIPTS["tap_fast"], 1).success
    task.close()


@pytest.mark.slow
@pytest.mark.parametrize(("task", "least"), [(GRASP, 0.9), (PICK_PLACE, 0.9)])
def test_the_strongest_tap_is_far_better_than_every_blind_script(task, least):
    seeds = range(80000, 80060)
    rates = {
        name: np.mean([attempt.success for attempt in outcomes(task, name, seeds)])
        for name, kind in players(task).items()
        if kind == "blind" or name == "tap_fast"
    }
    tapping = rates.pop("tap_fast")
    assert tapping >= least
    assert tapping > max(rates.values()) + 0.5


# Twin worlds


def test_twins_are_the_same_until_the_touch_and_hard_to_tell_apart_after_it():
    result = twin_test(GRASP, range(60000, 60007), n_pictured=1)
    assert result.n_episodes >= 6
    assert result.equal_until_touch, result.first_difference
    assert all(spread.value <= 0.6 for spread in result.auc.values())


def test_an_arm_without_sensor_noise_gives_the_touch_away():
    result = twin_test(GRASP, range(60000, 60006), n_pictured=0, variant="paper")
    assert all(spread.value > 0.9 for spread in result.auc.values())


def test_twins_that_are_never_touched_are_refused():
    with pytest.raises(ValueError, match="in 0 of 2 episodes"):
        twin_test(GRASP, range(60000, 60002), horizon=5)


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_classifiers_find_a_bend_and_nothing_in_noise(name):
    rng = np.random.default_rng(0)
    features = rng.standard_normal((1200, 6))
    labels = np.abs(features[:, 2]) > 0.7
    scores = CLASSIFIERS[name](features[:600], labels[:600])(features[600:])
    assert area_under_curve(scores, labels[600:]) > 0.9
    chance = rng.random(1200) < 0.5
    scores = CLASSIFIERS[name](features[:600], chance[:600])(features[600:])
    assert abs(area_under_curve(scores, chance[600:]) - 0.5) < 0.08


def test_ties_count_half():
    assert area_under_curve(np.zeros(10), np.arange(10) < 4) == 0.5
    assert area_under_curve(np.array([0, 1, 1, 2.0]), np.array([False, False, True, True])) == 0.875
    with pytest.raises(ValueError, match="Both classes"):
        area_under_curve(np.zeros(3), np.ones(3, dtype=bool))


# The check


def row(kind: str, successes: int, name: str = "someone") -> Row:
    return Row(name, kind, successes, 100, {"success": successes})


@pytest.mark.parametrize(
    ("kind", "successes", "holds"),
    [
        ("expert", 95, True),
        ("expert", 94, False),
        ("blind", 25, True),
        ("blind", 26, False),
        ("deaf", 30, True),
        ("deaf", 31, False),
        ("learned, deaf", 31, False),
        ("learned, hears", 29, False),
        ("learned, hears", 80, True),
    ],
)
def test_limits(kind, successes, holds):
    judged = judge([row("blind", 20, "best of the blind"), row("blind", 5), row(kind, successes, "judged")], Limits())
    if kind != "blind":
        assert judged[-1].holds is holds


@pytest.mark.parametrize(("successes", "holds"), [(35, True), (36, False)])
def test_without_a_blind_script_the_deaf_may_solve_what_one_may_and_the_margin(successes, holds):
    assert judge([row("deaf", successes)], Limits())[0].holds is holds
    assert judge([row("learned, hears", successes)], Limits())[0].holds is (successes >= 35)


@pytest.fixture
def nothing_hidden():
    """A task like Occluded Grasp, whose author forgot to say what is hidden. Gives its name."""
    definition = make_definition(GRASP, {}, warn=False)
    props = tuple(replace(prop, hidden=False) for prop in definition.props)
    name = "gym_playbyear/Forgotten-v0"
    gym.register(name, "gym_playbyear.task_env:TaskEnv", kwargs={"task": replace(definition, props=props)})
    yield name.split("/")[1]
    gym.registry.pop(name)


def test_twins_that_are_the_same_world_prove_nothing(nothing_hidden):
    report = check(nothing_hidden, 1, first_seed=1000, names=["middle"])
    assert report.twin is None
    assert [fault for fault in report.broken if "Forgotten-v0" in fault or "hides nothing" in fault]


def test_too_few_touches_are_told_after_who_played(capsys):
    report = check(GRASP, 2, first_seed=60000, names=["middle"], options={"horizon": 5})
    assert [row.name for row in report.rows] == ["middle"]
    assert report.broken == [
        "twin worlds: the expert touched the hidden object in 0 of 2 episodes, which is too few to "
        "compare them: four are needed."
    ]


def test_a_check_says_what_it_takes_from_one_that_was_stopped_and_refuses_a_learner_first(tmp_path, capsys):
    path = tmp_path / "check.partial"
    check(GRASP, 1, first_seed=1000, names=["middle"], twin=False, progress=path)
    assert "check.partial" not in capsys.readouterr().err
    check(GRASP, 1, first_seed=1000, names=["middle"], twin=False, progress=path)
    assert "check.partial has middle of a check that was stopped" in capsys.readouterr().err
    path.unlink()
    with pytest.raises(ValueError, match="'rl' is no learner's result"):
        check(GRASP, 1, first_seed=1000, names=["middle"], twin=False, progress=path, learned=[{"name": "rl"}])
    assert not path.exists()


def test_the_check_says_that_tapping_breaks_the_claim(tmp_path, monkeypatch, capsys):
    options = [GRASP, "--episodes=3", "--seed=1000", "--no-twin", "--players", "middle", "tap_fast"]
    monkeypatch.setattr(sys, "argv", ["check", *options, f"--output={tmp_path / 'check.json'}"])
    assert main() == 1
    assert "broken: tap_fast (deaf) solves" in capsys.readouterr().out
    rows = json.loads((tmp_path / "check.json").read_text())["rows"]
    assert [(row["name"], row["kind"]) for row in rows] == [("middle", "blind"), ("tap_fast", "deaf")]


@pytest.mark.slow
def test_processes_side_by_side_find_what_one_finds():
    options = {"first_seed": 1000, "names": ["middle", "nudge"], "twin": True}
    assert check(GRASP, 6, jobs=2, **options) == check(GRASP, 6, **options)


def test_the_check_holds_a_good_task_to_be_good_and_judges_a_learner():
    learned = [{"name": "rl", "hears": False, "successes": 1, "n_episodes": 10}]
    report = check(GRASP, 4, first_seed=1000, names=["expert"], learned=learned, twin=True)
    assert report.broken == []
    assert "all limits hold" in as_text(report)
    assert "every observation but sound is the same" in as_text(report)


def test_an_unknown_player_is_named():
    with pytest.raises(ValueError, match="player='tap_dance' is not known: choose from 'expert', 'middle'"):
        check(GRASP, 1, names=["tap_dance"])


# The task in numbers


def numbers(hears: bool, actions: np.ndarray) -> tuple[np.ndarray, float, NumericTask]:
    env = NumericTask(GRASP, hears=hears)
    seen, earned = [env.reset(seed=0)[0]], 0.0
    for action in actions:
        observation, reward, done, _, _ = env.step(action)
        seen.append(observation)
        earned += reward
        if done:
            break
    return np.stack(seen), earned, env


def test_a_deaf_learner_gets_no_contact_signal_and_one_that_hears_does():
    env = NumericTask(GRASP, hears=True, repeat=1)
    env.reset(seed=0)
    expert = env.task.env.scripted_expert()
    actions = []
    while not env.task.has_touched:
        env.begin_action()
        control = expert.act()
        env.advance(control)
        actions.append(np.append(control[:3] * 2, -1.0))
    heard = env.end_action(actions[-1])
    env.hears = False
    deaf = env.end_action(actions[-1])
    different = np.flatnonzero(heard != deaf)
    assert different.size
    assert different.min() >= N_PLAYER - 4
    assert different.max() < N_PLAYER
    assert not deaf[N_PLAYER - 4 : N_PLAYER].any()


def test_a_numeric_task_is_a_gymnasium_environment_whose_reward_is_bounded():
    rng = np.random.default_rng(0)
    seen, earned, env = numbers(False, rng.uniform(-1, 1, (20, 4)))
    assert all(env.observation_space.contains(observation) for observation in seen)
    assert abs(earned) < 10
    again, earned_again, _ = numbers(False, np.random.default_rng(0).uniform(-1, 1, (20, 4)))
    np.testing.assert_array_equal(seen, again)
    assert earned == earned_again


def test_the_recurrent_players_actions_do_not_depend_on_the_truth():
    torch = pytest.importorskip("torch")
    recurrent_player = pytest.importorskip("experiments.recurrent_player")
    space = NumericTask(GRASP, hears=False)
    policy = recurrent_player.RecurrentPlayer(space.observation_space, space.action_space, lambda _: 1e-3)
    observed = torch.randn(2, 5, space.observation_space.shape[0])
    other = observed.clone()
    other[..., N_PLAYER:] = torch.randn(2, 5, other.shape[-1] - N_PLAYER)
    assert torch.equal(recurrent_player.mean_actions(policy, observed), recurrent_player.mean_actions(policy, other))
    values = [policy.predict_values(seen[:, 0], None, torch.zeros(2)) for seen in (observed, other)]
    assert not torch.equal(*values)


def test_a_learner_goes_on_from_its_checkpoint(tmp_path, monkeypatch):
    adversaries = pytest.importorskip("experiments.adversaries")
    monkeypatch.setattr(adversaries, "RUNS", tmp_path)
    options = ["--n_envs=2", "--n_steps=16", "--n_demonstrations=2", "--imitation_updates=2", "--updates_per_trial=1"]
    options += ["--trial_episodes=1", "--episodes=1", "--horizon=20", f"--output={tmp_path / 'result.json'}"]
    options += ["--teacher=none"]
    adversaries.run(adversaries.parser().parse_args([*options, "--steps=64"]))
    result = adversaries.run(adversaries.parser().parse_args([*options, "--steps=128"]))
    assert [point["steps"] for point in result["curve"]] == [0, 64, 128]
    assert json.loads((tmp_path / "result.json").read_text())["n_episodes"] == 1
