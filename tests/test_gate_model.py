"""What a robot-gated method learns: novelty where no expert was, risk where attempts fail, thresholds for a wanted share."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_playbyear.dagger.methods.gate_model import (
    FOR_GOOD,
    Asking,
    GateModel,
    Played,
    Thresholds,
    Trace,
    thresholds_for,
)
from lerobot_playbyear.dagger.methods.remembering import check_memory
from lerobot_playbyear.datasets.errors import InputError

LIMITS = Thresholds(novelty=1.0, risk=0.5, calm_novelty=0.2, calm_risk=0.3)


def walk(side, success, is_visited, n=30, seed=0):
    """An episode that walks from the middle to one side; what the policy remembers is where it is."""
    rng = np.random.default_rng(seed)
    places = torch.linspace(0, 1, n).unsqueeze(1) * side
    noise = torch.from_numpy(rng.normal(0, 0.02, (n, 3))).float()
    memories = torch.cat([places, places.square(), torch.zeros(n, 1)], dim=1) + noise
    actions = torch.full((n, 2), 0.3) * side
    return Played(memories, actions, actions, np.full(n, not is_visited), success, is_visited, seed)


@pytest.fixture(scope="module")
def model():
    demonstrations = [walk(1.0, True, False, seed=seed) for seed in range(6)]
    attempts = [walk(side, side > 0, True, seed=10 + k) for k, side in enumerate((1.0, -1.0) * 5)]
    return GateModel(demonstrations + attempts, n_heads=5, n_updates=200, discount=0.9999, seed=0)


def test_where_no_expert_was_is_new_and_where_attempts_fail_is_risky(model):
    good, bad = walk(1.0, True, True, seed=99), walk(-1.0, False, True, seed=98)
    novelty = [model.novelty(each.memories)[-10:].mean() for each in (good, bad)]
    risk = [model.risk(each.memories, each.policy_actions)[-10:].mean() for each in (good, bad)]
    assert novelty[1] > 4 * novelty[0]
    assert risk[0] < 0.3 < 0.7 < risk[1]


def test_the_same_data_give_the_same_gate_and_nobody_elses_random_numbers_change():
    played = [walk(1.0, True, False), walk(-1.0, False, True)]
    torch.manual_seed(3)
    before = torch.get_rng_state()
    first, second = (GateModel(played, 2, 20, 0.99, seed=4) for _ in range(2))
    assert torch.equal(before, torch.get_rng_state())
    memories = played[0].memories
    assert torch.equal(first.novelty(memories), second.novelty(memories))
    assert torch.equal(first.risk(memories, played[0].actions), second.risk(memories, played[0].actions))


def test_success_after_the_expert_took_over_is_not_the_policys():
    """From the same places the policy alone fails, and with the expert's help the task is solved: they remain risky."""
    alone = [walk(-1.0, False, True, seed=seed) for seed in range(4)]
    helped = [walk(-1.0, True, True, seed=10 + seed) for seed in range(4)]
    for each in helped:
        each.by_expert[15:] = True
        each.memories[15:, 2] += 3.0  # the expert goes elsewhere
    shown = walk(1.0, True, False, seed=20)
    theirs = GateModel([shown, *alone, *helped], 2, 200, 0.9999, seed=0)
    place = alone[0].memories[5:14], alone[0].actions[5:14]
    for each in helped:
        each.by_expert[:] = False  # as if the policy had done it all
    own = GateModel([shown, *alone, *helped], 2, 200, 0.9999, seed=0)
    assert theirs.risk(*place).mean() > 0.8 > 0.7 > own.risk(*place).mean()


def test_the_robot_asks_until_it_is_calm_and_for_a_least_time():
    asking = Asking(LIMITS, n_least=3)
    calm, new, risky, uneasy = (0.1, 0.1), (1.5, 0.1), (0.1, 0.6), (0.9, 0.4)
    steps = [(0.5, 0.1), new, calm, calm, calm, risky, (0.1, 0.4), (0.5, 0.1), calm, uneasy]
    asks = "".join("x" if asking.asks(*step) else "." for step in steps)
    assert asks == ".xxx.xxx.."  # it does not begin to ask because it is uneasy


def test_a_robot_that_does_not_go_on_by_itself_asks_to_the_end():
    asking = Asking(LIMITS, FOR_GOOD)
    assert [asking.asks(*step) for step in [(0.1, 0.1), (1.5, 0.1), *[(0.1, 0.1)] * 50]] == [False, *[True] * 51]


def test_the_step_in_which_the_expert_takes_over_was_reached_by_the_policy(model):
    attempt = walk(1.0, True, True, n=6)
    attempt.by_expert[2:4] = True
    assert model.trace(attempt).is_own.tolist() == [True, True, True, False, False, True]


def wandering(rng):
    """An attempt of 100 steps by the policy alone, whose novelty and risk go up and down."""
    novelty, risk = rng.exponential(1, 120), rng.random(120)
    smooth = [np.convolve(values, np.ones(6) / 6)[:100] for values in (novelty, risk)]
    return Trace(*smooth, np.ones(100, bool))


@pytest.mark.parametrize(("share", "n_least"), [(0.1, 5), (0.3, 5), (0.3, FOR_GOOD)])
def test_thresholds_follow_from_the_wanted_share(share, n_least):
    rng = np.random.default_rng(0)
    traces = [wandering(rng) for _ in range(20)]
    limits = thresholds_for(traces, share, n_least)
    fresh, asked = Asking, 0
    for each in traces:
        asking = fresh(limits, n_least)
        asked += sum(asking.asks(*step) for step in zip(each.novelty, each.risk, strict=True))
    assert asked / 2000 == pytest.approx(share, abs=0.06)


@pytest.mark.parametrize("n_least", [5, FOR_GOOD])
def test_where_the_expert_brought_the_robot_does_not_count_for_the_share(n_least):
    """After a call in the middle of an attempt all is new and risky: a robot that asks there only never asks by itself."""
    rng = np.random.default_rng(0)
    traces = [wandering(rng) for _ in range(20)]
    for each in traces[::2]:
        each.is_own[51:] = False
        each.novelty[51:] += 10
        each.risk[51:] += 1
    limits = thresholds_for(traces, 0.3, n_least)
    asked = []
    for each in (wandering(rng) for _ in range(200)):
        asking = Asking(limits, n_least)
        asked += [asking.asks(*step) for step in zip(each.novelty, each.risk, strict=True)]
    assert np.mean(asked) == pytest.approx(0.3, abs=0.1)


def test_a_policy_without_a_memory_is_refused():
    parts = SimpleNamespace(policy=SimpleNamespace(config=SimpleNamespace(type="act")))
    parts.accelerator = SimpleNamespace(unwrap_model=lambda policy: policy)
    with pytest.raises(InputError, match=r"--method\.type=robot_gated.*'act' shows none.*--policy\.type=playbyear"):
        check_memory(SimpleNamespace(parts=parts))
