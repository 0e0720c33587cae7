"""The methods behind `--method.type`: who acts, what is recorded, what is kept, and that each resumes exactly."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dagger_factory import (
    QUICK,
    Quick,
    Scripted,
    assert_a_power_cut_changes_nothing,
    column,
    corrections,
    dagger,
    metrics,
    scene,
)

from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.dagger import gate_model
from lerobot_playbyear.dagger.gate_model import GateModel, Played, Trace, thresholds_for
from lerobot_playbyear.dagger.methods import Showing, Staying
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes.environment import env_spec
from lerobot_playbyear.episodes.experts import ScriptedExpertConfig
from lerobot_playbyear.episodes.play import Verdict, play
from lerobot_playbyear.training.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")

RUN = (*QUICK, "--num_episodes=2", "--warmup_episodes=1")
SHOWN = {"n_expert_steps": 8, "n_takeovers": 1, "n_switches": 1, "autonomy": 0.0, "person_seconds": 0.4}
"""What an attempt of which the expert makes all 8 steps costs."""


@pytest.fixture(autouse=True)
def few_updates(monkeypatch):
    """Of what a robot that asks learns."""
    monkeypatch.setattr(gate_model, "_N_UPDATES", 5)


def attempt(expert):
    """An attempt of 20 steps; the steps in which the expert acted, and the episode."""
    episode = play(*scene(), seed=5, expert=expert)
    return np.flatnonzero(episode.interventions).tolist(), episode


@pytest.mark.parametrize("decides", [False, True])
def test_a_person_who_stays_is_not_asked_to_act_in_the_step_that_they_ended(decides):
    expert = Scripted(steps=(4, 5), verdicts={7: Verdict.FAILURE})  # as where a leader no longer answers
    expert.decides = decides
    steps, episode = attempt(Staying(expert))
    assert (len(episode), episode.verdict) == (8, Verdict.FAILURE)
    assert steps == ([4, 5, 6] if decides else [4, 5, 6, 7])  # a script has an action for it


def test_a_try_that_a_person_throws_away_while_taking_over_did_not_fail():
    assert attempt(Showing(Scripted((4,))))[1].verdict is Verdict.FAILURE
    assert attempt(Showing(Scripted((4,), {4: Verdict.DISCARD})))[1].verdict is Verdict.DISCARD


def test_the_tasks_script_acts_from_the_first_step_if_it_is_told_to():
    env, actor = scene(n_steps=None)
    showing = Showing(ScriptedExpertConfig().make(env))
    showing.demonstrates = True
    episode = play(env, actor, seed=5, expert=showing)
    assert episode.interventions.all()
    assert episode.success


def test_where_no_gate_is_the_script_shows_what_the_policy_failed_in():
    env = env_spec(PlaybyearEnvConfig(task="TellApart-v1", image_size=16)).make()
    expert = ScriptedExpertConfig().make(env)
    showing = Showing(expert)
    still = SimpleNamespace(reset=lambda env: None, act=lambda observation: np.zeros(4, np.float32))
    tried = play(env, still, seed=5, expert=showing)
    assert (tried.success, tried.interventions.any()) == (False, False)
    showing.demonstrates = True
    shown = play(env, still, seed=5, expert=showing)
    env.close()
    assert (shown.success, shown.interventions.all(), expert.judges) == (True, True, False)
    with pytest.raises(AttributeError, match=r"TellApart-v1 has no intervention gate"):
        env.unwrapped.intervention_gate()


# Runs


def test_without_a_hand_back_an_attempt_ends_with_its_correction(tmp_path):
    dagger(tmp_path, *RUN, "--method.type=no_handback")
    marks = column(corrections(tmp_path), "intervention").reshape(2, 8)
    assert marks.tolist() == [[False, False, *[True] * 6]] * 2
    assert [line["takeover_steps"] for line in metrics(tmp_path, "attempt") if line["outcome"] == "kept"] == [[6], [6]]


@pytest.mark.slow
@pytest.mark.parametrize("kills", [(3,), pytest.param((2,), marks=pytest.mark.slow)])
def test_the_expert_shows_the_scenes_that_the_policy_fails_in(tmp_path, capfd, kills):
    run = (*RUN, "--method.type=redo")  # seeds that 3 divides end as failures, also of the expert
    dagger(tmp_path / "calm", *run)
    assert "context switches, autonomy 27%" in capfd.readouterr().out  # 3 steps of a try, 8 of a demonstration
    data, attempts = corrections(tmp_path / "calm"), metrics(tmp_path / "calm", "attempt")
    assert column(data, "intervention").all()
    np.testing.assert_allclose(column(data, "action"), np.tile([0.2, 0.1, -0.2, -1.0], (data.num_frames, 1)))
    told = [(line["seed"], line["outcome"], line["n_frames"], line["n_expert_steps"]) for line in attempts]
    assert told[:2] == [(10000, "failed", 3, 0), (10000, "kept", 8, 8)]
    assert attempts[1].items() >= SHOWN.items()
    for after in kills:  # the try counts, and its scene is not shown yet; the demonstration is saved and does not count
        assert_a_power_cut_changes_nothing(tmp_path / f"killed{after}", tmp_path / "calm", run, after)


def test_what_a_policy_solves_alone_is_not_shown_and_what_it_fails_at_unseen_is(tmp_path, monkeypatch):
    monkeypatch.setattr(Quick, "wants_control", lambda self, *_: setattr(self, "n", self.n + 1) is not None)
    seeds = ("--num_episodes=1", "--max_attempts=2", "--episode_seed=9998")  # those that 3 divides end as failures
    with pytest.raises(PlaybyearError, match="2 of 3 attempts in a row failed"):
        dagger(tmp_path, *QUICK, "--method.type=redo", *seeds)
    told = [(line["outcome"], line["n_expert_steps"]) for line in metrics(tmp_path, "attempt")]
    assert told == [("unneeded", 0), ("failed", 0), ("failed", 8)]
    assert metrics(tmp_path, "attempt")[0]["autonomy"] == 1


GATED = ("--method.type=robot_gated", "--method.rollouts=2", "--method.intervention_share=0.4")
ALONE = (*GATED, "--method.redo_failed=false")


def test_a_robot_asks_once_its_first_attempts_are_made_and_leaves_the_rest_to_the_expert(tmp_path):
    dagger(tmp_path, *QUICK, *ALONE, "--num_episodes=2", "--max_attempts=30")
    attempts = metrics(tmp_path, "attempt")
    assert [line["n_expert_steps"] for line in attempts[:2]] == [0, 0]
    asked = [line for line in attempts if line["n_takeovers"]]
    assert asked
    assert all(line["n_takeovers"] == 1 >= line["n_switches"] for line in asked)  # none where it asks at once
    assert all(line["person_seconds"] == pytest.approx(line["n_expert_steps"] / 20) for line in attempts)
    marks = column(corrections(tmp_path), "intervention").reshape(2, -1)
    assert all((np.diff(marks.astype(int), axis=1) >= 0).ravel())
    assert marks[:, -1].all()
    assert (tmp_path / "out/attempts/meta/info.json").is_file()


def succeeds_from_the_first_step_on(expert):
    expert.is_success |= expert.n == 0


@pytest.mark.slow
@pytest.mark.parametrize("kills", [(), pytest.param((1, 2, 3, 4, 5), marks=pytest.mark.slow)])
def test_what_fails_although_the_robot_may_ask_is_shown_from_its_first_step(tmp_path, monkeypatch, kills):
    """Of two attempts that the policy makes alone one fails, and is made good; a run that is killed on the way ends alike."""
    monkeypatch.setattr(Quick, "take_over", succeeds_from_the_first_step_on)
    run = (*QUICK, *GATED, "--num_episodes=2", "--warmup_episodes=1", "--episode_seed=9998")
    dagger(tmp_path / "calm", *run)
    attempts = metrics(tmp_path / "calm", "attempt")
    assert [line["outcome"] for line in attempts[:3]] == ["unneeded", "failed", "kept"]
    assert [line["seed"] for line in attempts[:4]] == [9998, 9999, 9999, 10000]
    assert attempts[2].items() >= SHOWN.items()
    assert column(corrections(tmp_path / "calm"), "intervention")[:8].all()
    assert not attempts[0]["n_expert_steps"]
    for after in kills:
        assert_a_power_cut_changes_nothing(tmp_path / f"killed{after}", tmp_path / "calm", run, after)


@pytest.mark.slow
def test_new_weights_forget_the_policy_and_keep_its_normalisation(tmp_path, monkeypatch):
    dagger(tmp_path, *RUN)
    seen, update = [], Learner.update

    def look(parts, *args):
        seen.append({key: value.clone() for key, value in parts.policy.state_dict().items()})
        return update(parts, *args)

    monkeypatch.setattr(Learner, "update", look)
    offline = ("--num_episodes=0", "--steps=1", f"--interventions.root={tmp_path / 'corrections'}")
    for name, options in (("old", ()), ("new", ("--new_weights=true",)), ("again", ("--new_weights=true",))):
        dagger(tmp_path, *offline, *options, f"--output_dir={tmp_path / name}", env=())
    old, new, again = seen
    differ = {key for key in old if not np.array_equal(old[key], new[key])}
    assert any("lstm" in key for key in differ)
    assert not any("spectrogram" in key for key in differ)
    assert all(np.array_equal(new[key], again[key]) for key in new)


# What a robot that asks knows


def walk(side, success, is_visited, n=30, seed=0):
    """An episode that walks from the middle to one side; what the policy remembers is where it is."""
    rng = np.random.default_rng(seed)
    places = torch.linspace(0, 1, n).unsqueeze(1) * side
    noise = torch.from_numpy(rng.normal(0, 0.02, (n, 3))).float()
    memories = torch.cat([places, places.square(), torch.zeros(n, 1)], dim=1) + noise
    actions = torch.full((n, 2), 0.3) * side
    return Played(memories, actions, actions, np.full(n, not is_visited), success, is_visited, seed)


@pytest.mark.slow
def test_where_no_expert_was_is_new_and_where_attempts_fail_is_risky(monkeypatch):
    monkeypatch.setattr(gate_model, "_N_UPDATES", 200)
    demonstrations = [walk(1.0, True, False, seed=seed) for seed in range(6)]
    attempts = [walk(side, side > 0, True, seed=10 + k) for k, side in enumerate((1.0, -1.0) * 5)]
    torch.manual_seed(3)
    before = torch.get_rng_state()
    model = GateModel(demonstrations + attempts, seed=0)
    assert torch.equal(before, torch.get_rng_state())
    good, bad = walk(1.0, True, True, seed=99), walk(-1.0, False, True, seed=98)
    novelty = [model.novelty(each.memories)[-10:].mean() for each in (good, bad)]
    risk = [model.risk(each.memories, each.policy_actions)[-10:].mean() for each in (good, bad)]
    assert novelty[1] > 4 * novelty[0]
    assert risk[0] < 0.3 < 0.7 < risk[1]
    good.by_expert[2:4] = True  # the step in which the expert takes over was reached by the policy
    assert model.trace(good).is_own[:6].tolist() == [True, True, True, False, False, True]


@pytest.mark.slow
def test_success_after_the_expert_took_over_is_not_the_policys(monkeypatch):
    """From the same places the policy alone fails, and with the expert's help the task is solved: they remain risky."""
    monkeypatch.setattr(gate_model, "_N_UPDATES", 200)
    monkeypatch.setattr(gate_model, "_N_HEADS", 1)  # novelty is not asked for
    alone = [walk(-1.0, False, True, seed=seed) for seed in range(4)]
    helped = [walk(-1.0, True, True, seed=10 + seed) for seed in range(4)]
    for each in helped:
        each.by_expert[15:] = True
        each.memories[15:, 2] += 3.0  # the expert goes elsewhere
    shown = walk(1.0, True, False, seed=20)
    theirs = GateModel([shown, *alone, *helped], seed=0)
    place = alone[0].memories[5:14], alone[0].actions[5:14]
    for each in helped:
        each.by_expert[:] = False  # as if the policy had done it all
    own = GateModel([shown, *alone, *helped], seed=0)
    assert theirs.risk(*place).mean() > 0.8 > 0.7 > own.risk(*place).mean()


def wandering(rng):
    """An attempt of 100 steps by the policy alone, whose novelty and risk go up and down."""
    novelty, risk = rng.exponential(1, 120), rng.random(120)
    smooth = [np.convolve(values, np.ones(6) / 6)[:100] for values in (novelty, risk)]
    return Trace(*smooth, np.ones(100, bool))


@pytest.mark.parametrize(("share", "is_helped"), [(0.1, False), (0.3, False), (0.3, True)])
def test_thresholds_follow_from_the_wanted_share(share, is_helped):
    """Also where the expert brought the robot to what is new and risky: who asks only there never asks by themselves."""
    rng = np.random.default_rng(0)
    traces = [wandering(rng) for _ in range(20)]
    for each in traces[::2] if is_helped else ():
        each.is_own[51:] = False
        each.novelty[51:] += 10
        each.risk[51:] += 1
    limits = thresholds_for(traces, share)
    fresh = [wandering(rng) for _ in range(200)]
    asked = [np.logical_or.accumulate(limits.are_exceeded(each.novelty, each.risk)) for each in fresh]
    assert np.mean(asked) == pytest.approx(share, abs=0.1)
