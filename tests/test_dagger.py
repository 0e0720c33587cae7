"""HG-DAgger: attempts, what is recorded of them, rounds, checkpoints that LeRobot's commands take."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dagger_factory import (
    QUICK,
    Quick,
    Scripted,
    arguments,
    column,
    corrections,
    dagger,
    metrics,
    scene,
    seeds,
    state,
    weights,
)
from dataset_factory import rollout_dataset
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from support.shared import ENV, n_evaluated, run_in_process, trained

from lerobot_playbyear.dagger.config import DaggerConfig
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.datasets.reader import DatasetPlace
from lerobot_playbyear.episodes.play import Verdict, play
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.scripts.commands import dagger as dagger_script

pytestmark = pytest.mark.usefixtures("one_thread")


# Attempts


def test_the_whole_attempt_is_recorded_and_tagged_where_the_expert_acted_and_the_policy_remembers_it_all():
    expert = Scripted(steps=range(4, 9))
    env, actor = scene()
    episode = play(env, actor, seed=5, expert=expert)
    assert np.flatnonzero(episode.interventions).tolist() == list(range(4, 9))
    for step, action in expert.actions.items():
        np.testing.assert_array_equal(episode.actions[step], action)
    observation, _ = env.reset(seed=5)
    for t, action in enumerate(episode.actions):
        np.testing.assert_array_equal(observation["agent_pos"], episode.observations[t]["agent_pos"])
        observation, _, terminated, truncated, _ = env.step(action)
    assert terminated or truncated
    assert len(episode) == t + 1
    actor.reset(env)
    seen = [actor.act(observation) for observation in episode.observations[:-1]]
    np.testing.assert_allclose(np.clip(seen[9], -1, 1), episode.actions[9], atol=1e-6)


# A run


def test_a_run_collects_learns_saves_and_evaluates(finished):
    rounds = metrics(finished, "round")
    evaluations = metrics(finished, "eval")
    attempts = metrics(finished, "attempt")

    assert [line["round"] for line in rounds] == [1, 2, 3]
    assert [line["step"] for line in rounds] == [0, 2, 4]  # the first is warming up
    assert [line["round"] for line in evaluations] == [0, 2, 3]
    assert [line["outcome"] for line in attempts].count("kept") == 3
    for line in rounds[1:]:
        assert line["loss_demonstrations"] > 0
        assert line["loss_interventions"] > 0
        parts = ["simulation", "inference", "update", "batch", "loss", "episode_saving", "checkpoint_saving"]
        assert line["total_s"] == pytest.approx(sum(line[f"{part}_s"] for part in parts), rel=0.2)
    assert {path.name for path in (finished / "out/checkpoints").iterdir()} == {"000002", "000004", "last", "best"}
    assert {(finished / "out/checkpoints" / name).resolve().name for name in ("last", "best")} == {"000004"}
    check_normalisation_is_kept(finished / "out/checkpoints/last/pretrained_model")


def test_figures_of_the_field_stand_in_every_line(finished):
    attempts, last = metrics(finished, "attempt"), metrics(finished, "round")[-1]
    cost = {"n_expert_steps": 3, "n_takeovers": 1, "takeover_steps": [3], "n_switches": 2, "person_seconds": 0.4}
    assert all({key: line[key] for key in cost} == cost for line in attempts)
    n = len(attempts)
    assert (last["expert_steps"], last["takeovers"], last["switches"]) == (3 * n, n, 2 * n)
    assert last["autonomy"] == pytest.approx(5 / 8)
    assert [line["expert_steps"] for line in metrics(finished, "eval")][::2] == [0, 3 * n]


def test_the_dataset_is_a_plain_one_of_successes_with_corrections(finished):
    dataset = corrections(finished)
    intervention, success = column(dataset, "intervention").ravel(), column(dataset, "next.success").ravel()

    assert dataset.num_episodes == 3
    shares = [1 - line["autonomy"] for line in metrics(finished, "attempt") if line["outcome"] == "kept"]
    for row, share in zip(dataset.meta.episodes, shares, strict=True):
        episode = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert success[episode][-1]
        assert 0 < intervention[episode].mean() == pytest.approx(share, abs=1e-3)
    assert seeds(finished) == [line["seed"] for line in metrics(finished, "attempt") if line["outcome"] == "kept"]
    assert dataset[0]["observation.audio.gripper"].shape == (800,)


def check_normalisation_is_kept(tuned):
    """Of actions, low-dimensional observations and sound. Batch norm's averages are the network's, and follow its weights."""
    base = trained()
    files = sorted(path.name for path in base.glob("policy_*processor*.safetensors"))
    assert files
    for name in files:
        before, after = load_file(base / name), load_file(tuned / name)
        assert all(torch.equal(before[key], after[key]) for key in before)
    before, after = (load_file(path / "model.safetensors") for path in (base, tuned))
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    sound = {f"model.spectrogram.audio_gripper.{name}" for name in ("mean", "variance", "n_batches")}
    assert sound <= set(before)
    assert not sound & changed
    assert any(key.endswith("bn1.running_mean") for key in changed)
    assert any(key.endswith("weight") for key in changed)


def test_lerobots_commands_take_the_checkpoint_and_the_dataset(finished, tmp_path):
    policy = finished / "out/checkpoints/last/pretrained_model"
    assert n_evaluated(policy, tmp_path / "eval", *ENV, "--env.episode_length=5") == 1
    data = ("--dataset.repo_id=tests/corrections", f"--dataset.root={finished / 'corrections'}", "--num_workers=0")
    small = ("--steps=1", "--batch_size=2", "--dataset.video_backend=pyav", "--env_eval_freq=0")
    run_in_process(lerobot_train.train, f"--policy.path={policy}", *data, *small, f"--output_dir={tmp_path / 'tuned'}")
    assert (tmp_path / "tuned/checkpoints/000001").is_dir()


def test_the_rate_rises_once_and_falls_in_every_round_and_over_the_run():
    cfg = DaggerConfig(DatasetPlace("a/b"), DatasetPlace("c/d"), learning_rate=1.0, warmup_updates=4)
    cfg.num_episodes, cfg.warmup_episodes, cfg.updates_per_episode = 7, 3, 10
    rounds = [[cfg.rate(10 * done + number, number, 10) for number in range(10)] for done in range(6)]
    first, second, last = rounds[0], rounds[1], rounds[4]
    assert cfg.total_updates() == 50
    assert first[:3] == [0.25, pytest.approx(0.5 * second[1] / second[0]), pytest.approx(0.75 * second[2] / second[0])]
    assert all(rates[1:] == sorted(rates[1:], reverse=True) and rates[-1] < 0.05 for rates in rounds[1:])
    assert [rates[0] for rates in rounds] == pytest.approx([0.25, 0.82, 0.64, 0.46, 0.28, 0.1])
    assert rounds[5][0] < last[0]
    recorded = DaggerConfig(DatasetPlace("a/b"), DatasetPlace("c/d"), learning_rate=1.0, warmup_updates=0)
    recorded.num_episodes, recorded.steps = 0, 50  # from recorded corrections it falls once
    assert [recorded.rate(step, step % 10, 10) for step in (0, 25, 49)] == pytest.approx([1.0, 0.5, 0.001], abs=1e-3)
    cfg.num_episodes = 2
    appended = [cfg.rate(10 * done, 0, 10, n_before=5) for done in range(3)]
    assert appended == pytest.approx([0.25, 0.55, 0.1])
    cfg.anneal = False
    assert cfg.rate(17, 7, 10) == 1
    cfg.policy, cfg.learning_rate = PlaybyearConfig(optimizer_lr=2e-3), None
    assert cfg.training().optimizer.lr == cfg.largest_rate == 2e-3  # without a rate the policy says it


# Who is kept


def attempts_end(monkeypatch, acts, verdicts):
    """After three steps, with the verdict of their seed, a failure if it has none; in those of `acts` the expert acts."""

    def wants_control(self, observation, policy_action):
        self.n += 1
        return self.n == 2 and self.seed in acts

    def verdict(self):
        return verdicts.get(self.seed, Verdict.FAILURE) if self.n == 3 else None

    monkeypatch.setattr(Quick, "wants_control", wants_control)
    monkeypatch.setattr(Quick, "verdict", verdict)


def test_only_successes_with_an_intervention_are_kept_and_seeds_are_consecutive_and_none_of_an_evaluation(
    tmp_path, monkeypatch
):
    verdicts = {11: Verdict.SUCCESS, 12: Verdict.SUCCESS, 14: Verdict.DISCARD, 17: Verdict.SUCCESS}
    attempts_end(monkeypatch, {10, 12, 13, 14, 17}, verdicts)
    evaluation = ("--seed=15", "--eval.n_episodes=2", "--eval.batch_size=2")
    dagger(tmp_path, *QUICK, "--episode_seed=10", "--num_episodes=2", *evaluation)

    assert seeds(tmp_path) == [12, 17]
    counts = {key: state(tmp_path)[key] for key in ("attempts", "kept", "failed", "unneeded", "discarded")}
    assert counts == {"attempts": 6, "kept": 2, "failed": 2, "unneeded": 1, "discarded": 1}
    outcomes = ["failed", "unneeded", "kept", "failed", "discarded", "kept"]
    told = [(line["seed"], line["outcome"]) for line in metrics(tmp_path, "attempt")]
    assert told == list(zip([10, 11, 12, 13, 14, 17], outcomes, strict=True))
    assert all(line["n_frames"] == 3 for line in metrics(tmp_path, "attempt"))  # the expert ends them


def test_what_a_person_throws_away_is_repeated(tmp_path, monkeypatch):
    attempts_end(monkeypatch, {10}, {10: Verdict.DISCARD})
    monkeypatch.setattr(Quick, "decides", True)
    dagger(tmp_path, *QUICK, "--episode_seed=10", "--num_episodes=1", "--max_attempts=2")
    assert [(line["seed"], line["outcome"]) for line in metrics(tmp_path, "attempt")] == [(10, "discarded")] * 2


def test_a_policy_that_needs_no_help_ends_the_run(tmp_path, monkeypatch, capfd):
    attempts_end(monkeypatch, {10}, dict.fromkeys(range(10, 14), Verdict.SUCCESS))
    out = dagger(tmp_path, *QUICK, "--episode_seed=10", "--num_episodes=5", "--max_attempts=3")
    assert "needed no help in 3 attempts in a row" in "".join(capfd.readouterr())
    assert seeds(tmp_path) == [10]
    assert (out / "checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_the_interventions_of_another_run_are_appended_to(finished, tmp_path):
    shutil.copytree(finished / "corrections", tmp_path / "corrections")
    dagger(tmp_path, *QUICK, "--num_episodes=1")
    before, after = seeds(finished), seeds(tmp_path)
    assert after[:3] == before
    assert len(after) == 4
    assert after[3] > max(before)


# From recorded corrections alone


def test_without_an_environment_it_learns_from_what_is_there_but_for_the_beginning_of_corrections(
    finished, tmp_path, capfd
):
    corrected = ("--num_episodes=0", f"--interventions.root={finished / 'corrections'}")
    for options, n in (((), 3), (("--skip_s=0",), 9)):  # three corrections of 3 frames, a memory of 2
        out = dagger(tmp_path / str(n), *corrected, "--steps=5", *options, env=())
        said = capfd.readouterr()
        assert "No correction is longer" not in said.err
        assert f"Corrections: {n} of 9 frames that the expert chose are learned from" in said.out
        assert ("the first 0.1 s of every correction are left out" in said.out) is (n == 3)
        assert [line["step"] for line in metrics(tmp_path / str(n), "round")] == [2, 4, 5]
        assert (out / "checkpoints/last").resolve().name == "000005"
    check_normalisation_is_kept(out / "checkpoints/last/pretrained_model")


def test_it_learns_from_what_lerobots_rollout_recorded_and_nothing_of_what_the_policy_did(tmp_path):
    """Of whole attempts with tags, as videos: LeRobot's default."""
    learned = []
    for by_policy in (0.0, 5.0):
        folder = tmp_path / str(by_policy)
        rollout_dataset(folder / "rollout", (20, 14), lambda step: 5 <= step < 12, use_videos=True, by_policy=by_policy)
        recorded = ("--num_episodes=0", "--steps=2", f"--interventions.root={folder / 'rollout'}")
        dagger(folder, *recorded, env=())
        assert metrics(folder, "round")[-1]["loss_interventions"] > 0
        learned.append(weights(folder))
    before = load_file(trained() / "model.safetensors")
    assert any(not torch.equal(learned[0][key], before[key]) for key in before)
    assert all(torch.equal(learned[0][key], learned[1][key]) for key in before)


def test_a_fault_of_the_program_shows_where_it_happened(monkeypatch, tmp_path):
    def work():
        raise ValueError("a fault")

    monkeypatch.setattr("lerobot_playbyear.dagger.run._make_loop", lambda *_: SimpleNamespace(run=work))
    with pytest.raises(ValueError, match=r"^a fault$") as error:
        run_in_process(dagger_script, *arguments(tmp_path, *QUICK))
    assert not isinstance(error.value, PlaybyearError)
