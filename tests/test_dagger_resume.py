"""A run of HG-DAgger that is killed at any moment goes on and ends as one that was not; nothing is lost or doubled."""

import contextlib
import json
import os
import re
import resource
import shutil
import signal
import time

import numpy as np
import pytest
import torch
from dagger_factory import (
    FINISHED,
    QUICK,
    Quick,
    arguments,
    assert_a_power_cut_changes_nothing,
    assert_ended_alike,
    column,
    command,
    corrections,
    dagger,
    figures,
    metrics,
    seeds,
    state,
    weights,
)
from lerobot.configs import parser
from safetensors.torch import load_file
from support.failing import PowerCut, fail_once
from support.shared import trained

from lerobot_playbyear.dagger import run_folder as folder_module
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.errors import PlaybyearError
from lerobot_playbyear.episodes.play import Verdict
from lerobot_playbyear.training.learner import Learner

pytestmark = pytest.mark.usefixtures("one_thread")


RUN = (*QUICK, *FINISHED)


@pytest.mark.parametrize(
    ("owner", "name", "after"),
    [
        (folder_module.RunFolder, "commit", 3),  # the attempt is on disk and not yet counted
        pytest.param(os, "rename", 0, marks=pytest.mark.slow),  # the checkpoint is not yet at its place
        pytest.param(folder_module.RunFolder, "clean", 3, marks=pytest.mark.slow),  # `last` is behind
        pytest.param(DurableWriter, "add_frame", 20, marks=pytest.mark.slow),  # while an attempt is written
        pytest.param(folder_module.RunFolder, "save_checkpoint", 1, marks=pytest.mark.slow),
        pytest.param(Learner, "evaluate", 1, marks=pytest.mark.slow),
    ],
    ids=["counting", "placing", "cleaning", "writing", "saving", "evaluating"],
)
def test_wherever_it_stops_it_ends_alike(finished, tmp_path, owner, name, after):
    assert_a_power_cut_changes_nothing(tmp_path, finished, RUN, after, owner, name)


@pytest.mark.slow
def test_attempts_in_vain_count_on_after_a_resume(tmp_path, monkeypatch):
    monkeypatch.setattr(Quick, "verdict", lambda self: Verdict.FAILURE if self.n >= self.n_steps else None)
    run = (*QUICK, "--num_episodes=1", "--max_attempts=3")
    with monkeypatch.context() as patch:
        fail_once(patch, folder_module.RunFolder, "commit", 3)  # the third attempt does not count
        with pytest.raises(PowerCut):
            dagger(tmp_path, *run)
    for n in (3, 6):  # who goes on with a run that has given up wants others
        with pytest.raises(PlaybyearError, match="3 of 3 attempts in a row failed"):
            command("--resume=true", f"--output_dir={tmp_path / 'out'}")
        assert state(tmp_path)["failed"] == n


@pytest.mark.slow
def test_a_policys_options_stay_until_there_is_a_checkpoint(tmp_path, monkeypatch):
    """Those of a file and of a resume; and the policy that a link named when the run began."""
    policy, link, options = trained().resolve(), tmp_path / "link", tmp_path / "run.yaml"
    link.symlink_to(policy)
    options.write_text(f"policy:\n  path: {link}\n  low_dimensional_noise: 0.25\n  optimizer_lr: 0.002\n")
    args = [each for each in arguments(tmp_path, *RUN) if not each.startswith("--policy.path")]
    with monkeypatch.context() as patch:
        for name in ("_config_path_args", "_config_yaml_overrides"):  # that LeRobot keeps for the process
            patch.setattr(parser, name, {})
        fail_once(patch, folder_module.RunFolder, "commit", 1)
        with pytest.raises(PowerCut):
            command(f"--config_path={options}", *args)
    link.unlink()
    link.symlink_to(tmp_path)
    again = ("--resume=true", f"--output_dir={tmp_path / 'out'}")
    with monkeypatch.context() as patch:
        fail_once(patch, folder_module.RunFolder, "commit", 1)
        with pytest.raises(PowerCut):
            command(*again, f"--policy.path={policy}", "--policy.optimizer_weight_decay=0.125")
    command(*again)
    config = json.loads((tmp_path / "out/checkpoints/last/pretrained_model/config.json").read_text())
    names = ("low_dimensional_noise", "optimizer_lr", "optimizer_weight_decay")
    assert [config[name] for name in names] == [0.25, 0.002, 0.125]
    assert len(state(tmp_path)["policy_overrides"]) == 3


@pytest.mark.slow
def test_more_episodes_go_on_with_a_finished_run_that_asked_for_it(finished, tmp_path):
    dagger(tmp_path, *RUN, "--num_episodes=2", "--resume=true")  # where there is none yet
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=3")
    assert seeds(tmp_path) == seeds(finished)
    ours, theirs = weights(tmp_path), weights(finished)
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_a_finished_run_stays_as_it_is(finished, tmp_path):
    n_before = len(seeds(finished))
    shutil.copytree(finished / "out", tmp_path / "out", symlinks=True)
    command("--resume=true", f"--output_dir={tmp_path / 'out'}")
    assert (figures(tmp_path), state(tmp_path), len(seeds(finished))) == (figures(finished), state(finished), n_before)


def copied(finished, folder):
    """A finished run in a folder of its own, with its own attempts. Returns the output folder."""
    shutil.copytree(finished, folder, symlinks=True, dirs_exist_ok=True)
    config = folder / "out/dagger_config.json"
    config.write_text(config.read_text().replace(str(finished), str(folder)))
    return folder / "out"


@pytest.mark.parametrize("left", ["metrics.jsonl", "checkpoints"])
def test_a_run_that_lost_its_state_loses_nothing_else(finished, tmp_path, left):
    out = copied(finished, tmp_path)
    (out / "dagger_state.json").unlink()
    if left == "checkpoints":
        (out / "metrics.jsonl").unlink()
    else:
        shutil.rmtree(out / "checkpoints")
    with pytest.raises(PlaybyearError, match=r"dagger_state\.json is missing: put it back from a copy, or choose"):
        dagger(tmp_path, *RUN, "--resume=true")
    assert (out / left).stat().st_size


def test_a_training_that_diverges_keeps_the_last_good_weights(finished, tmp_path):
    out = copied(finished, tmp_path)
    before, go_on = weights(tmp_path), ("--resume=true", f"--output_dir={out}", "--num_episodes=4", "--eval_every=0")
    with pytest.raises(
        PlaybyearError, match=r"diverged in round 4: .* last good weights are .*/000004\. Go on .*=1e\+37"
    ):
        command(*go_on, "--learning_rate=1e38")
    assert all(torch.equal(weights(tmp_path)[key], before[key]) for key in before)
    command(*go_on, "--learning_rate=1e-4")
    assert state(tmp_path)["checkpoint"] == "000006"


def test_a_run_whose_attempts_lie_in_its_folder_may_be_stopped_before_it_begins(tmp_path, monkeypatch):
    run = (*RUN, "--resume=true", f"--interventions.root={tmp_path / 'out/attempts'}", "--num_episodes=1")
    with monkeypatch.context() as patch:
        fail_once(patch, folder_module.RunFolder, "begin", 0)
        with pytest.raises(PowerCut):
            dagger(tmp_path, *run)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["attempts"]
    dagger(tmp_path, *run)
    assert (tmp_path / "out/attempts/meta/info.json").is_file()


def test_only_one_run_works_in_a_folder(tmp_path):
    at_work = folder_module.RunFolder(tmp_path / "out").locked()
    with at_work, pytest.raises(PlaybyearError, match="another playbyear-dagger is at work there"):
        dagger(tmp_path, *RUN)
    assert not (tmp_path / "out").exists()


def test_resuming_another_run_names_the_differences(finished, tmp_path):
    shutil.copytree(finished / "out", tmp_path / "out", symlinks=True)
    changed = ("--env.task=OccludedPickPlace-v1", "--dataset.repo_id=other/demos", "--expert.n_steps=9")
    more = ("--episode_seed=5", "--policy.path=elsewhere", "--num_episodes=0", "--steps=5")
    with pytest.raises(PlaybyearError, match="holds another run: ") as refused:
        dagger(tmp_path, "--resume=true", *QUICK, *changed, *more)
    for difference in (
        r"--env was .*OccludedGrasp-v1.* and is .*OccludedPickPlace-v1",
        r"--dataset was .*tests/demos.* and is .*other/demos",
        r"--expert was .*'n_steps': 8.* and is .*'n_steps': 9",
        "--episode_seed was 10000 and is 5",
        "--policy.path was .*pretrained_model and is elsewhere",
        "--num_episodes was 3 and is 0",
    ):
        assert re.search(difference, str(refused.value))


def test_a_dataset_that_something_else_changed_is_refused(finished, tmp_path):
    shutil.copytree(finished / "out", tmp_path / "out", symlinks=True)
    state = json.loads((tmp_path / "out/dagger_state.json").read_text())
    state["kept"] = state["round"] = 5
    (tmp_path / "out/dagger_state.json").write_text(json.dumps(state))
    with pytest.raises(PlaybyearError, match="holds 3 attempts, and this run knows of 5"):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=8")


def test_a_disk_that_is_not_mounted_holds_no_new_dataset(finished, tmp_path):
    out = copied(finished, tmp_path)
    shutil.rmtree(tmp_path / "corrections")
    (tmp_path / "corrections").mkdir()  # where it would be mounted
    with pytest.raises(PlaybyearError, match=r"no dataset in .*corrections, and 3 attempts .* Is its disk mounted"):
        command("--resume=true", f"--output_dir={out}", "--num_episodes=4")
    assert not list((tmp_path / "corrections").iterdir())


# `checkpoints/best`: the weights of the best evaluation; all that were evaluated are kept


EVALUATED = (*QUICK, "--warmup_episodes=1", "--eval_every=2", "--eval.n_episodes=1")


@pytest.fixture
def gives(monkeypatch):
    """Says what the next evaluations will give [%]."""
    rates: list[float] = []

    def evaluate(*_):
        return {"overall": {"pc_success": rates.pop(0), "pc_acted_early": 7.5, "n_episodes": 1}}

    monkeypatch.setattr(Learner, "evaluate", evaluate)
    return rates


@pytest.mark.slow
def test_the_best_evaluation_keeps_its_weights(tmp_path, gives, monkeypatch, capfd):
    checkpoints = tmp_path / "out/checkpoints"

    def go_on(*options):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", *options)
        assert gives == []
        return (checkpoints / "best").resolve(), (checkpoints / "last").resolve()

    def cut_after_the_best(folder, state, clean=folder_module.RunFolder.clean):
        if state.best.get("success") == 60:
            raise PowerCut
        clean(folder, state)

    gives += [10, 30, 60]
    with monkeypatch.context() as patch:
        patch.setattr(folder_module.RunFolder, "clean", cut_after_the_best)
        with pytest.raises(PowerCut):
            dagger(tmp_path, *EVALUATED, "--num_episodes=3")  # evaluated after 0, 2 and 3 attempts
    third = (checkpoints / state(tmp_path)["checkpoint"]).resolve()
    gives += [20, 50]
    best, last = go_on("--num_episodes=5")
    assert (best, last.name) == (third, state(tmp_path)["checkpoint"])
    assert (best / "pretrained_model/model.safetensors").is_file()
    assert best != last
    assert f"Best:        60.0 % of them: {checkpoints / 'best/pretrained_model'}" in capfd.readouterr().out

    gives += [60, 50]  # of equal ones the last
    best, last = go_on("--num_episodes=7")
    assert best not in (third, last)
    assert third.exists()  # as all that were evaluated
    shutil.rmtree(best)  # to make room
    gives += [40]
    capfd.readouterr()
    best, last = go_on("--num_episodes=8")
    assert best == last
    assert "Best:" not in capfd.readouterr().out


def test_the_policy_that_a_run_began_with_may_be_the_best_and_other_episodes_are_evaluated(tmp_path, gives, capfd):
    gives += [30, 20]
    dagger(tmp_path, *EVALUATED, "--num_episodes=1")
    assert not (tmp_path / "out/checkpoints/best").is_symlink()
    assert f"Best:        30.0 % of them: {state(tmp_path)['policy_path']}" in capfd.readouterr().out
    gives += [40]
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--eval.n_episodes=2")
    printed = "Success:     40.0 % of 2 episodes\nEarly:       7.5 % of them acted before anything was heard\n"
    assert printed in capfd.readouterr().out
    assert [line["pc_success"] for line in metrics(tmp_path, "eval")] == [30, 20, 40]


def test_a_checkpoint_that_was_evaluated_at_the_end_stays_when_the_run_goes_on(tmp_path, gives):
    gives += [30, 20]
    dagger(tmp_path, *EVALUATED, "--num_episodes=1")
    gives += [40]
    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=2")
    assert {path.name for path in (tmp_path / "out/checkpoints").iterdir()} == {"000002", "000004", "last", "best"}


# SIGKILL: a process of its own, killed by the operating system


def run_and_kill(commands, folder, n_kills, *options):
    """Runs the command, kills it n times after random times, and lets it end."""
    rng = np.random.default_rng(0)
    run = ("playbyear-dagger", *arguments(folder, *options), "--resume=true")
    for _ in range(n_kills):
        end = time.monotonic() + rng.uniform(2.0, 12.0)
        assert commands.run(*run, kill_when=lambda end=end: time.monotonic() > end).status == -signal.SIGKILL
        assert_everything_loads(folder)
    commands.succeed(*run)


def assert_everything_loads(folder):
    """After a kill: the dataset with plain LeRobot, the newest checkpoint, the state."""
    if (folder / "corrections/meta/info.json").exists():
        dataset = corrections(folder)
        assert len(column(dataset, "action")) == dataset.num_frames
    if (folder / "out/dagger_state.json").exists():
        checkpoint = state(folder)["checkpoint"]
        if checkpoint is not None:
            load_file(folder / "out/checkpoints" / checkpoint / "pretrained_model/model.safetensors")
            load_file(folder / "out/checkpoints" / checkpoint / "training_state/optimizer_state.safetensors")


def assert_complete(folder, n_episodes):
    found = seeds(folder)
    assert len(found) == n_episodes
    assert found == sorted(set(found)), "an attempt is there twice"
    kept = [line["seed"] for line in metrics(folder, "attempt") if line["outcome"] == "kept"]
    assert kept == found
    attempts = [line["attempt"] for line in metrics(folder, "attempt")]
    assert attempts == list(range(1, state(folder)["attempts"] + 1))
    assert [line["round"] for line in metrics(folder, "round")] == list(range(1, n_episodes + 1))
    assert (folder / "out/checkpoints/last/pretrained_model/model.safetensors").is_file()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_killed_twenty_times_it_ends_complete_and_alike(commands, tmp_path):
    """The scripted expert, whole attempts, evaluations; and the weights of a run that was never killed."""
    options = (
        "--eval_every=2",
        "--eval.n_episodes=2",
        "--warmup_episodes=2",
        "--updates_per_episode=20",
        "--num_episodes=8",  # of which each takes some attempts: no machine has ended before the twentieth kill
        "--env.episode_length=200",  # in less the expert rescues nobody
        "--max_attempts=1000",  # attempts in vain count on after each kill
    )
    run_and_kill(commands, tmp_path / "killed", 20, *options)
    assert_complete(tmp_path / "killed", 8)
    run_and_kill(commands, tmp_path / "calm", 0, *options)
    assert_ended_alike(tmp_path / "killed", tmp_path / "calm")


# What cannot be written


@contextlib.contextmanager
def small_disk(n_bytes):
    """No file can become larger than this: writing more fails, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.slow
def test_a_full_disk_is_reported_and_harms_nothing(tmp_path):
    """It has no room for a checkpoint; `test_failed_saves.py` has the episodes."""
    message = r"Cannot write to .*out.*What was saved before is complete.*--resume=true"
    run = (*RUN, "--env.episode_length=70", "--expert.n_steps=60")
    dagger(tmp_path, *run, "--num_episodes=2")
    before = weights(tmp_path), seeds(tmp_path)
    with small_disk(300_000), pytest.raises(PlaybyearError, match=message):
        command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=4")
    assert seeds(tmp_path)[:2] == before[1]
    assert all(torch.equal(weights(tmp_path)[key], before[0][key]) for key in before[0])
    assert not list((tmp_path / "out/checkpoints").glob("*.partial"))

    command("--resume=true", f"--output_dir={tmp_path / 'out'}", "--num_episodes=3")
    assert_complete(tmp_path, 3)
