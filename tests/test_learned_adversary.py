"""The learned adversary: the tasks in numbers, a player whose actions do not depend on the truth, the committed table."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "examples/learned_adversary"))
from numeric_task import N_HEARD, N_PLAYER, NumericTask

RESULTS = Path(__file__).parents[1] / "results"
EASY, HARD, POUCH = "KeyBag-Easy-v1", "KeyBag-Hard-v1", "TellApart-v1"


def test_the_recurrent_players_actions_do_not_depend_on_the_truth():
    torch = pytest.importorskip("torch")
    recurrent_player = pytest.importorskip("recurrent_player")
    space = NumericTask("OccludedGrasp-v1", hears=False)
    policy = recurrent_player.RecurrentPlayer(space.observation_space, space.action_space, lambda _: 1e-3)
    observed = torch.randn(2, 5, space.observation_space.shape[0])
    other = observed.clone()
    other[..., N_PLAYER:] = torch.randn(2, 5, other.shape[-1] - N_PLAYER)
    assert torch.equal(recurrent_player.mean_actions(policy, observed), recurrent_player.mean_actions(policy, other))
    values = [policy.predict_values(seen[:, 0], None, torch.zeros(2)) for seen in (observed, other)]
    assert not torch.equal(*values)


def test_a_learner_goes_on_from_its_checkpoint(tmp_path, monkeypatch):
    adversaries = pytest.importorskip("learn")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    options = ["--n_envs=2", "--n_steps=16", "--n_demonstrations=2", "--imitation_updates=2", "--updates_per_trial=1"]
    options += ["--trial_episodes=1", "--episodes=1", "--horizon=20", f"--output={tmp_path / 'result.json'}"]
    options += [f"--folder={tmp_path / 'run'}"]
    options += ["--teacher=none"]
    adversaries.run(adversaries.parser().parse_args([*options, "--steps=64"]))
    result = adversaries.run(adversaries.parser().parse_args([*options, "--steps=128"]))
    assert [point["steps"] for point in result["curve"]] == [0, 64, 128]
    assert json.loads((tmp_path / "result.json").read_text())["n_episodes"] == 1
    assert not list(tmp_path.glob("SB3*"))


def test_a_player_imitates_the_expert():
    recurrent_player = pytest.importorskip("recurrent_player")
    env = NumericTask("OccludedGrasp-v1", hears=True)
    ((observations, actions),) = recurrent_player.demonstrations(env, "expert", range(10000, 10001))
    assert len(observations) == len(actions) > 10
    assert actions[-1][3] == 1.0, "the hand is closed when it lifts"


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


# The committed table


def test_the_committed_table_is_what_the_results_say():
    """`results/adversaries.md` says of every script what `results/adversaries.jsonl` does."""
    rows = [json.loads(line) for line in (RESULTS / "adversaries.jsonl").read_text().splitlines()]
    players = {row["task"]: row["players"] for row in rows}
    lines = (line.split("|")[1:-1] for line in (RESULTS / "adversaries.md").read_text().splitlines())
    table = [[cell.strip(" `*") for cell in line] for line in lines if len(line) == 6]
    tasks = next(line[1:] for line in table if "OccludedGrasp-v1" in line)
    compared = 0
    for head, *cells in table:
        name = head.rpartition("`")[2] if "`" in head else head
        for task, cell in zip(tasks, cells, strict=True):
            each = players[task].get(name)
            if each is not None:
                assert cell == f"{100 * each['successes'] / each['n_episodes']:.0f} %", (head, task)
                compared += 1
    assert compared == 44  # 20 more are of scripts that never led and are not played any more
