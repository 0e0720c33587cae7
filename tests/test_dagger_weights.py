"""What is learned from how often: weighted kinds of frames, all frames of an attempt, and figures of what experts spent."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.policies.act.configuration_act import ACTConfig
from test_dagger_batches import N_DEMONSTRATIONS, store, supervised, windows

from lerobot_playbyear.dagger import curves
from lerobot_playbyear.dagger.config import DaggerConfig, DatasetSource
from lerobot_playbyear.dagger.figures import Totals, attempt_figures, round_figures, steps_until
from lerobot_playbyear.dagger.methods.base import Learned, Method
from lerobot_playbyear.dagger.methods.weighted import Weighted, WeightedConfig, kinds_of_frames, shares
from lerobot_playbyear.dagger.weighted_batches import WeightedBatches, how_often_drawn, learned_per_run
from lerobot_playbyear.datasets import run_weights
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training.windows import PolicyWindows

ATTEMPTS = "......................xxxxxxxxxx........" + "xx......xxxx...................."
COUNTS = {"intervention": 100.0, "before": 30.0, "policy": 370.0, "demonstrations": 500.0}


def chunks(n_actions):
    config = ACTConfig(chunk_size=n_actions, n_action_steps=n_actions, device="cpu", push_to_hub=False)
    return PolicyWindows(config, SimpleNamespace(fps=20, features={"action": {}, "observation.state": {}}))


def learned_shares(learned, n_windows, n_batches=400):
    """How often each frame of the attempts was learned from, and the share of demonstrations."""
    attempts = store([40, 32], ATTEMPTS, first=N_DEMONSTRATIONS)
    batches = WeightedBatches(windows(n_windows), store([60, 40]), attempts, 12, 0, learned)
    counts, n_demonstrated = np.zeros(len(ATTEMPTS)), 0
    for number in range(n_batches):
        batch = batches.batch(number)
        assert len(batch["action"]) == 12
        ends = supervised(batch).numpy() if "action_is_pad" in batch else batch["action"].int().numpy().ravel()
        n_demonstrated += (ends < N_DEMONSTRATIONS).sum()
        np.add.at(counts, ends[ends >= N_DEMONSTRATIONS] - N_DEMONSTRATIONS, 1)
    return counts / counts.sum(), n_demonstrated / (n_demonstrated + counts.sum())


@pytest.mark.parametrize("n_windows", [1, 8])
def test_frames_are_learned_from_as_their_weights_say(n_windows):
    weights = torch.linspace(0, 1, len(ATTEMPTS), dtype=torch.float64)
    weights[25:30] = 4.0
    weights[50:53] = 0.0
    seen, demonstrated = learned_shares(lambda attempts: Learned(weights, 0.25), n_windows)
    wanted = (weights / weights.sum()).numpy()
    assert not seen[wanted == 0].any()
    np.testing.assert_allclose(seen, wanted, atol=0.012)
    assert demonstrated == pytest.approx(0.25, abs=0.01)


def test_runs_lie_where_frames_weigh_alike_so_that_few_actions_are_computed_in_vain():
    attempts, kinds = store([40, 32], ATTEMPTS), kinds_of_frames(store([40, 32], ATTEMPTS), 4)
    few = torch.from_numpy((kinds == 0) * 1.0)  # stretches of 10, 2 and 4 frames
    learned = learned_per_run(attempts, few, how_often_drawn(attempts, few, 8), 8)
    assert learned == pytest.approx(16 / 4)  # two runs for ten frames, one each for two and four
    assert learned > 1.5 * learned_per_run(attempts, few, run_weights(attempts, 8, few), 8)
    for weights in (torch.ones(len(ATTEMPTS)).double(), torch.from_numpy(np.where(kinds == 0, 3.0, 1.0))):
        drawn = how_often_drawn(attempts, weights, 8)
        by_means = learned_per_run(attempts, weights, run_weights(attempts, 8, weights), 8)
        assert by_means < learned_per_run(attempts, weights, drawn, 8) <= 8
    smooth = torch.linspace(1, 2, len(ATTEMPTS), dtype=torch.float64)
    assert learned_per_run(attempts, smooth, how_often_drawn(attempts, smooth, 8), 8) > 2


def test_of_a_chunk_those_actions_remain_that_weigh_as_much_as_its_observation():
    attempts = store([40, 32], ATTEMPTS, first=N_DEMONSTRATIONS)
    kinds = kinds_of_frames(attempts, 4)
    weights = torch.from_numpy(np.select([kinds == 0, kinds == 2], [1.0, 0.25], 0.0))
    batches = WeightedBatches(chunks(8), store([60, 40]), attempts, 12, 0, lambda attempts: Learned(weights, 0.25))
    n_learned, starts = 0, np.zeros(len(ATTEMPTS))
    for number in range(300):
        batch = batches.batch(number)
        n = int((batch["action"][:, 0, 0] < N_DEMONSTRATIONS).sum())
        first = batch["action"][n:, 0, 0].int().numpy() - N_DEMONSTRATIONS
        np.add.at(starts, first, 1)
        learned = (~batch["action_is_pad"][n:]).numpy()
        frames = np.minimum(first[:, None] + np.arange(8), len(ATTEMPTS) - 1)
        assert not learned[weights.numpy()[frames] == 0].any()
        n_learned += learned.sum()
    np.testing.assert_allclose(starts / starts.sum(), (weights / weights.sum()).numpy(), atol=0.02)
    assert n_learned / 300 / 9 > 3


def test_all_frames_of_attempts_are_learned_from_alike():
    method = Method(SimpleNamespace(learn_from="all"))
    assert method.weighs_frames
    seen, demonstrated = learned_shares(lambda attempts: method.learned(100, attempts), 4)
    np.testing.assert_allclose(seen, 1 / len(ATTEMPTS), atol=0.006)
    assert demonstrated == pytest.approx(0.5, abs=0.01)


def test_a_kind_of_frames_has_its_share_however_many_there_are():
    method = Weighted(SimpleNamespace(learn_from="expert", n_skipped=lambda fps: 0), WeightedConfig(before_s=0.5))
    seen, demonstrated = learned_shares(lambda attempts: method.learned(100, attempts), 4)
    kinds = kinds_of_frames(store([40, 32], ATTEMPTS), 10)
    assert demonstrated == pytest.approx(0.5, abs=0.01)
    assert seen[kinds == 0].sum() == pytest.approx(
        1, abs=0.01
    )  # demonstrations are more than half: none is left for others
    assert not seen[kinds == 1].any()


def test_what_came_before_an_intervention_ends_at_the_attempts_start_and_at_the_expert():
    kinds = kinds_of_frames(store([8, 10], "..xx..x." + "x..xx....."), 3)
    assert "".join("xb."[kind] for kind in kinds) == "bbxxbbx." + "xbbxx....."


def test_the_beginning_of_an_intervention_is_a_kind_that_is_not_learned_from():
    kinds = kinds_of_frames(store([8, 10], "xxx.xxxx" + "x..xx....."), 3, n_skipped=2)
    assert "".join("xb.-"[kind] for kind in kinds) == "xxxb--xx" + "xbb--....."
    cfg = DaggerConfig(
        DatasetSource("demos"), DatasetSource("corrections"), method=WeightedConfig(before_s=0.5), skip_s=0.2
    )
    cfg.policy = PlaybyearConfig(n_memory_steps=3, device="cpu", push_to_hub=False)
    learned = Weighted(cfg, cfg.method).learned(100, store([40, 32], ATTEMPTS))
    assert "".join("x" if weight else "." for weight in learned.weights) == ("." * 26 + "x" * 6 + "." * 8) + (
        "xx" + "." * 30
    )
    cfg.skip_s = None
    assert cfg.n_skipped(20) == 0


def test_the_papers_shares():
    sirius, iwr = (shares(COUNTS, WeightedConfig(paper=paper)) for paper in ("sirius", "iwr"))
    assert sirius == {"intervention": 0.5, "before": 0.0, "policy": 0.0, "demonstrations": 0.5}
    few = shares({**COUNTS, "demonstrations": 125.0}, WeightedConfig())
    assert few == pytest.approx({"intervention": 0.5, "before": 0.0, "policy": 0.3, "demonstrations": 0.2})
    assert iwr == pytest.approx(
        {"intervention": 0.5, "before": 30 / 1800, "policy": 370 / 1800, "demonstrations": 500 / 1800}
    )


def test_a_share_that_is_given_wins_and_one_without_frames_is_divided():
    wanted = shares({**COUNTS, "before": 0.0}, WeightedConfig(before=0.3, policy=0.5, demonstrations=1.0))
    assert wanted == pytest.approx({"intervention": 0.25, "before": 0.0, "policy": 0.25, "demonstrations": 0.5})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"paper": "sirus"}, "--method.paper='sirus': give sirius or iwr"),
        ({"policy": -0.1}, "--method.policy=-0.1: give a share of 0 or more"),
        ({"demonstrations": 0.0}, "--method.demonstrations=0: give a share above 0"),
        ({"before_s": float("inf")}, "--method.before_s=inf"),
    ],
)
def test_shares_that_mean_nothing(options, message):
    with pytest.raises(InputError, match=message):
        WeightedConfig(**options).check()


# Figures


def test_takeovers_their_lengths_and_switches_of_an_attempt():
    control = np.array([mark == "x" for mark in "..xxx....xx"])
    figures = attempt_figures(control, 5, fps=20, is_watched=True)
    assert figures == {
        "n_expert_steps": 5,
        "n_takeovers": 2,
        "takeover_steps": [3, 2],
        "n_switches": 3,
        "autonomy": round(6 / 11, 4),
        "person_seconds": 0.55,
    }
    assert attempt_figures(control, 5, fps=20, is_watched=False)["person_seconds"] == 0.25
    assert attempt_figures(np.ones(4, bool), 4, 20, True)["n_switches"] == 0


def attempt(number, **more):
    line = {"kind": "attempt", "round": number, "n_frames": 100, "intervention_share": 0.2}
    return line | more


def test_totals_count_lines_of_older_versions_by_their_share():
    new = {"n_expert_steps": 100, "n_takeovers": 1, "takeover_steps": [40], "n_switches": 2, "person_seconds": 5.0}
    lines = [attempt(0), attempt(1, **new), {"kind": "round", "round": 1}]
    totals = Totals.of(lines)
    assert (totals.attempts, totals.expert_steps, totals.controlled_steps, totals.switches) == (2, 120, 60, 2)
    assert totals.autonomy == pytest.approx(0.7)
    assert round_figures(lines, 2)["autonomy"] == 0.6  # of the second round's attempt alone
    assert round_figures(lines, 2)["expert_steps"] == 120


def test_steps_until_a_success_are_those_of_the_first_evaluation_that_has_it():
    lines = [
        {"kind": "eval", "pc_success": success, "expert_steps": n}
        for success, n in ((40, 0), (85, 300), (70, 600), (92, 900))
    ]
    assert (steps_until(lines, 80), steps_until(lines, 90), steps_until(lines, 95)) == (300, 900, None)


def test_curves_and_their_table(tmp_path, monkeypatch, capsys):
    for name, last in (("hg", 92.0), ("thrifty", 60.0)):
        evaluations = [
            {"kind": "eval", "round": n, "pc_success": success, "expert_steps": 120 * n, "person_seconds": 6.0 * n}
            for n, success in enumerate((40.0, last))
        ]
        rounds = [{"kind": "round", "round": 1, **round_figures([attempt(0)], 1)}]
        (tmp_path / name).mkdir()
        lines = [attempt(0), *rounds, *evaluations]
        (tmp_path / name / "metrics.jsonl").write_text(
            "".join(json.dumps(line) + "\n" for line in lines) + '{"kind": "ev'
        )
    picture = tmp_path / "curves.png"
    folders = [str(tmp_path / name) for name in ("hg", "thrifty")]
    monkeypatch.setattr(sys, "argv", ["curves", *folders, f"--output={picture}"])
    curves.main()
    rows = [row.split(" | ") for row in capsys.readouterr().out.splitlines() if row.startswith("| /")]
    assert [row[1:5] for row in rows] == [["92", "20", "120", "120"], ["60", "20", "-", "-"]]
    assert picture.stat().st_size > 1000
    assert curves.curves_of(curves.read_lines(tmp_path / "hg"))["success"] == ([0, 120], [40, 92])
    for place in ("missing/curves.png", "curves.poem"):
        monkeypatch.setattr(sys, "argv", ["curves", *folders, f"--output={tmp_path / place}"])
        with pytest.raises(SystemExit, match=f"{place} cannot be written"):
            curves.main()
    with pytest.raises(InputError, match=r"there is no metrics\.jsonl"):
        curves.read_lines(tmp_path)
