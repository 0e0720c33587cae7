"""The learned adversary: the tasks in numbers, a player whose actions do not depend on the truth, the committed table."""

import json

import numpy as np
import pytest

from experiments import adversary_table
from experiments.numeric_task import N_HEARD, N_PLAYER, NumericTask
from experiments.protocol import save
from gym_playbyear.experts.key_bag import finger_forces

EASY, HARD, POUCH = "KeyBag-Easy-v1", "KeyBag-Hard-v1", "TellApart-v1"


def numbers(hears: bool, actions: np.ndarray) -> tuple[np.ndarray, float, NumericTask]:
    env = NumericTask("OccludedGrasp-v1", hears=hears)
    seen, earned = [env.reset(seed=0)[0]], 0.0
    for action in actions:
        observation, reward, done, _, _ = env.step(action)
        seen.append(observation)
        earned += reward
        if done:
            break
    return np.stack(seen), earned, env


def test_a_deaf_learner_gets_no_contact_signal_and_one_that_hears_does():
    env = NumericTask("OccludedGrasp-v1", hears=True, repeat=1)
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
    space = NumericTask("OccludedGrasp-v1", hears=False)
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
