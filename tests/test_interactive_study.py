"""The study of corrections: what it runs, in which order, and what it counts; the commands themselves are imitated."""

import json
from argparse import Namespace
from dataclasses import asdict

import pytest

from experiments import interactive
from experiments.training import Evaluation, Job

DEFAULTS = {
    "method": "hg_dagger",
    "learn": "new_weights",
    "course": "own",
    "kept": 4,
    "rounds": 2,
    "updates": 30,
    "controls": interactive.CONTROLS,
}


@pytest.fixture
def ran(monkeypatch, tmp_path):
    """What would have been run: the commands of `playbyear-dagger`, trainings and recordings."""
    told = {"dagger": [], "train": [], "record": []}
    monkeypatch.setattr(interactive, "RUNS", tmp_path)
    meta = tmp_path / "demos" / "meta"
    meta.mkdir(parents=True)
    (meta / "info.json").write_text(json.dumps({"total_frames": 500, "total_episodes": 50}))

    def clocked(command, folder, threads):
        told["dagger"].append(command)
        folder.mkdir(parents=True, exist_ok=True)
        attempt = {
            "kind": "attempt",
            "outcome": "kept",
            "n_frames": 40,
            "intervention_share": 0.25,
            "n_expert_steps": 10,
        }
        if "--episodes=0" not in command:
            (folder / "metrics.jsonl").write_text(
                json.dumps(attempt | {"takeover_steps": [10], "n_takeovers": 1}) + "\n"
            )
        (folder / "dagger_state.json").write_text(json.dumps({"step": 30}))
        return 1.0

    def train(job):
        told["train"].append(job)
        return "playbyear-train ...", 1.0

    def evaluate(job, commands, name, checkpoint):
        commands.append(f"lerobot-eval {checkpoint.name}")
        return Evaluation([True, True, False, False], [], ["success", "success", "pressed", "time"], [1, 2, 0, 0])

    monkeypatch.setattr(interactive, "clocked", clocked)
    monkeypatch.setattr(interactive, "train", train)
    monkeypatch.setattr(interactive, "evaluate", evaluate)
    monkeypatch.setattr(interactive, "record", lambda *args: told["record"].append(args))
    return told


def study(tmp_path, task="OccludedGrasp-v1", **options) -> interactive.Study:
    job = Job("ablations", task, "full", 1, dataset=tmp_path / "demos")
    return interactive.Study(job, Namespace(**DEFAULTS | options))


def test_rounds_collect_with_the_newest_policy_and_learn_anew(ran, tmp_path):
    result = study(tmp_path).run()
    collected = [command for command in ran["dagger"] if "--updates_per_episode=0" in command]
    learned = [command for command in ran["dagger"] if "--new_weights=true" in command]
    assert [next(o for o in command if o.startswith("--episodes")) for command in collected] == [
        "--episodes=2",
        "--episodes=4",
    ]
    assert len(learned) == 2
    first = result.outcomes[0]
    assert (first.success, first.first_search, first.failures) == (50, 25, "1 pressed, 1 time")
    assert [outcome.expert_steps for outcome in result.outcomes] == [0, 10, 20]
    assert [outcome.updates for outcome in result.outcomes] == [0, 30, 60]
    assert [outcome.kept for outcome in result.outcomes] == [0, 1, 2]
    assert "learn1" in next(o for o in collected[1] if o.startswith("--policy.path"))


def test_controls_have_as_many_updates_and_as_many_expert_steps(ran, tmp_path):
    result = study(tmp_path).run()
    base, updates, further = ran["train"]
    assert (updates.steps, updates.n_demonstrations) == (60, base.n_demonstrations)
    assert (further.steps, further.n_demonstrations) == (base.steps, base.n_demonstrations + 2)  # 20 steps, 10 each
    assert further.dataset != base.dataset
    assert result.controls.keys() == {"updates", "demonstrations"}


def test_online_goes_on_with_one_run(ran, tmp_path):
    result = study(tmp_path, learn="online", method="robot_gated", controls=()).run()
    folders = {next(o for o in command if o.startswith("--output_dir")) for command in ran["dagger"]}
    assert len(folders) == 1
    assert all("--method.type=robot_gated" in command for command in ran["dagger"])
    assert [outcome.updates for outcome in result.outcomes] == [0, 30, 30]


def test_the_papers_course_begins_with_the_easy_bag(ran, tmp_path):
    study(tmp_path, task="KeyBag-Hard-v1", course="paper", kept=40, rounds=1, controls=()).run()
    tasks = [
        (o, next(e for e in command if e.startswith("--episodes")))
        for command in ran["dagger"]
        for o in command
        if "env.task" in o
    ]
    assert tasks == [("--env.task=KeyBag-Easy-v1", "--episodes=12"), ("--env.task=KeyBag-Hard-v1", "--episodes=40")]


def test_what_was_evaluated_is_not_evaluated_again(ran, tmp_path, monkeypatch):
    first = study(tmp_path).run()
    monkeypatch.setattr(interactive, "evaluate", None)
    assert asdict(study(tmp_path).run()) == asdict(first)
