"""The study of corrections: what it runs, in which order, and what it counts; the commands themselves are imitated."""

import json
import subprocess
import sys
import threading
import time
from argparse import Namespace
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from experiments import interactive, interactive_parts, protocol, training
from experiments.interactive_parts import alone, demonstrated, first_job, is_written_to, trained
from experiments.protocol import STEPS
from experiments.training import Job
from lerobot_env_playbyear import PlaybyearEnvConfig
from lerobot_playbyear.training.presets import preset_options

DEFAULTS = {
    "method": "hg_dagger",
    "learn": "new_weights",
    "course": "own",
    "kept": 4,
    "rounds": 2,
    "updates": 30,
    "grow": False,
    "controls": interactive.CONTROLS,
}
DEMONSTRATION_STEPS, EXPERT_STEPS = 10, 7  # of a demonstration, and in an attempt that is kept


class Killed(BaseException):
    """The study and its command end, without a word."""


class Commands:
    """Imitates the commands: the files that they write, and what they refuse.

    Attributes:
        told: The options of every command that ran, in order; the name is among them.
        killed: Number of the command that is killed, and when: "before" it begins, "halfway", or "after" its end.
        needs_no_help: Whether the policy is never corrected.
    """

    def __init__(self, killed=(-1, "")):
        self.told: list[dict[str, str]] = []
        self.killed, self.needs_no_help = killed, False

    def __call__(self, command, name, threads):
        options = dict(part.removeprefix("--").partition("=")[::2] for part in command[1:])
        number, when = self.killed
        is_last = number == len(self.told)
        self.told.append(options | {"command": command[0]})
        if is_last and when == "before":
            raise Killed
        getattr(self, command[0].replace("-", "_"))(options, is_last and when == "halfway")
        if is_last:
            raise Killed

    def of(self, name) -> list[dict[str, str]]:
        return [options for options in self.told if options["command"] == name]

    def playbyear_record(self, options, halfway):
        n = int(options["dataset.num_episodes"]) // (2 if halfway else 1)
        write(
            Path(options["dataset.root"]) / "meta" / "info.json",
            {"total_episodes": n, "total_frames": DEMONSTRATION_STEPS * n},
        )

    def playbyear_train(self, options, halfway):
        if "config_path" in options:
            options = json.loads(Path(options["config_path"]).read_text())["given"]
        folder, steps = Path(options["output_dir"]), int(options["steps"])
        folder.mkdir(parents=True, exist_ok="start" in options)
        given = (preset_options(options["preset"]) if "preset" in options else {}) | options
        policy = {key.removeprefix("policy."): of(value) for key, value in given.items() if key.startswith("policy.")}
        config = {"policy": policy, "batch_size": of(given["batch_size"]), "given": options | {"start": "again"}}
        checkpoint(folder, f"{1 if halfway else steps:06}", config)

    def lerobot_eval(self, options, halfway):
        seeds = range(int(options["seed"]), int(options["seed"]) + int(options["eval.n_episodes"]))
        ends, n_closings = ("success", "time", "success", "pressed"), (1, 1, 2, 0)
        lines = [{"seed": seed, "end": ends[seed % 4], "n_closings": n_closings[seed % 4]} for seed in seeds]
        contents = ("peanuts", "screws", "screws", "screws")
        lines = [line | {"contents": contents[seed % 4]} for seed, line in zip(seeds, lines, strict=True)]
        attempts = Path(options["env.attempts_file"])
        attempts.parent.mkdir(parents=True, exist_ok=True)
        attempts.write_text("".join(json.dumps(line) + "\n" for line in lines))
        if not halfway:
            successes = [seed % 2 == 0 for seed in seeds]
            write(attempts.with_name("eval_info.json"), {"per_task": [{"metrics": {"successes": successes}}]})

    def playbyear_dagger(self, options, halfway):
        """As `lerobot_playbyear.dagger` in what counts here: whose attempts are whose in the dataset, and what is refused."""
        folder, dataset = Path(options["output_dir"]), Path(options["interventions.root"]) / "kept.json"
        state_path = folder / "dagger_state.json"
        n = json.loads(dataset.read_text()) if dataset.exists() else 0
        new = {"policy": options["policy.path"], "first": n, "kept": 0, "step": 0, "checkpoint": None}
        state = json.loads(state_path.read_text()) if state_path.exists() else new
        assert state["policy"] == options["policy.path"], "--output_dir holds another run"
        assert Path(options["policy.path"]).exists()
        write(folder / "dagger_config.json", {})
        episodes = int(options["episodes"])
        if episodes == 0:
            assert n > 0, "the intervention dataset is empty"
            state |= {"step": int(options["updates"]) // (2 if halfway else 1)}
        else:
            heard = PlaybyearEnvConfig(
                task=options["env.task"], microphones=json.loads(options.get("env.microphones", "null"))
            )
            assert heard.microphones == PlaybyearEnvConfig(task=folder.name.split("-full-")[0]).microphones
            unnoted = n - state["first"] - state["kept"]
            assert unnoted in (0, 1), "something else changed the dataset"
            assert state["kept"] or n < episodes, "the dataset holds enough already"
            with (folder / "metrics.jsonl").open("a") as figures:
                for _ in range(unnoted):  # in the dataset before the run was killed, or so it seems
                    figures.write(json.dumps({**ATTEMPT, "recovered": True}) + "\n")
                if self.needs_no_help:
                    figures.write(json.dumps({**ATTEMPT, "outcome": "unneeded", "n_expert_steps": 0}) + "\n")
                while n < episodes and not self.needs_no_help:
                    figures.write(json.dumps(ATTEMPT) + "\n")
                    n, state["kept"] = n + 1, state["kept"] + 1
                    write(dataset, n)
                    if n >= 5:  # --warmup_episodes
                        state["step"] += int(options["updates_per_episode"])
                    if halfway:
                        break
        if state["step"]:
            state["checkpoint"] = f"{state['step']:06}"
            checkpoint(folder, state["checkpoint"], {})
        write(state_path, state)


ATTEMPT = {
    "kind": "attempt",
    "outcome": "kept",
    "n_frames": 40,
    "intervention_share": 0.175,
    "n_expert_steps": EXPERT_STEPS,
    "n_takeovers": 1,
    "takeover_steps": [EXPERT_STEPS],
}


def of(option):
    """The value that an option gives."""
    try:
        return json.loads(option)
    except json.JSONDecodeError:
        return option


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def checkpoint(folder, name, config):
    write(folder / "checkpoints" / name / "pretrained_model" / "train_config.json", config)
    last = folder / "checkpoints" / "last"
    last.unlink(missing_ok=True)
    last.symlink_to(name)


@pytest.fixture
def begin(monkeypatch, tmp_path):
    """Begins with an empty folder; returns the commands that are run there."""

    def begin(folder=tmp_path / "runs", **how) -> Commands:
        commands = Commands(**how)
        for module in (interactive, interactive_parts, protocol, training):
            monkeypatch.setattr(module, "RUNS", folder)
        for module in (interactive, protocol, training):
            monkeypatch.setattr(module, "RESULTS", folder / "results")
        monkeypatch.setattr(interactive_parts, "is_written_to", lambda path: False)  # looks at all processes
        monkeypatch.setattr(protocol, "run", commands)
        monkeypatch.setattr(training, "run", commands)
        return commands

    return begin


@pytest.fixture
def ran(begin):
    return begin()


def study(task="OccludedGrasp-v1", training_options=(), **options) -> interactive.Study:
    return interactive.Study(first_job(task, 1, 50, training_options), Namespace(**DEFAULTS | options))


def test_rounds_collect_with_the_newest_policy_and_learn_anew(ran):
    result = study().run()
    collected = [command for command in ran.of("playbyear-dagger") if command.get("updates_per_episode") == "0"]
    learned = [command for command in ran.of("playbyear-dagger") if "new_weights" in command]
    assert [command["episodes"] for command in collected] == ["2", "4"]
    assert len(learned) == 2
    assert "learn1" in collected[1]["policy.path"]
    assert [outcome.expert_steps for outcome in result.outcomes] == [0, 2 * EXPERT_STEPS, 4 * EXPERT_STEPS]
    assert [outcome.kept for outcome in result.outcomes] == [0, 2, 4]


def test_a_single_round_grows_too(ran):
    plain, grown = study(rounds=1).run(), study(rounds=1, grow=True).run()
    assert [outcome.updates for outcome in (*plain.outcomes[1:], *grown.outcomes[1:])] == [30, 60]
    assert len([command for command in ran.of("playbyear-dagger") if int(command["episodes"])]) == 1


def test_rounds_that_grow_share_what_was_collected(ran):
    plain = study().run()
    n_collected, n_learned = 2, 2
    grown = study(grow=True, controls=("updates",)).run()
    dagger = ran.of("playbyear-dagger")
    assert len(dagger) == n_collected + n_learned + 1  # the second round alone has more updates
    assert dagger[-1]["updates"] == "60"
    assert [outcome.updates for outcome in grown.outcomes[1:]] == [30, 60]
    assert grown.outcomes[:2] == plain.outcomes[:2]
    assert grown.controls["updates"].updates == 60


@pytest.mark.parametrize("when", ["before", "halfway", "after"])
@pytest.mark.parametrize(
    "options", [{}, {"learn": "online", "kept": 8}, {"course": "paper", "kept": 28, "task": "KeyBag-Hard-v1"}]
)
def test_a_study_that_was_killed_at_any_moment_goes_on_and_counts_nothing_twice(begin, tmp_path, options, when):
    commands = begin(tmp_path / "whole")
    whole = asdict(study(**options).run())
    for number in range(len(commands.told)):
        begin(tmp_path / f"{number}", killed=(number, when))
        with pytest.raises(Killed):
            study(**options).run()
        begin(tmp_path / f"{number}")
        assert asdict(study(**options).run()) == whole


def test_what_is_finished_does_not_run_again(ran):
    first = study().run()
    n = len(ran.told)
    assert asdict(study().run()) == asdict(first)
    assert len(ran.told) == n


def test_updates_are_those_that_a_policys_weights_got(ran):
    assert [outcome.updates for outcome in study().run().outcomes] == [STEPS, 30, 30]  # new weights in each round
    online = study(learn="online", kept=14).run()  # 60 // 14 after every kept attempt from the fifth on
    assert [outcome.updates for outcome in online.outcomes] == [STEPS, STEPS + 3 * 4, STEPS + 10 * 4]


@pytest.mark.parametrize("options", [{}, {"learn": "online", "kept": 14}, {"updates": STEPS}])
def test_controls_get_as_many_updates_and_as_many_expert_steps(ran, options):
    result = study(**options).run()
    last, updates, further = result.outcomes[-1], *result.controls.values()
    assert updates.updates == further.updates == last.updates
    spent = last.expert_steps
    assert spent <= further.expert_steps < spent + DEMONSTRATION_STEPS
    assert (updates.n_demonstrations, updates.expert_steps) == (50, 0)
    assert further.n_demonstrations == 50 + further.expert_steps / DEMONSTRATION_STEPS
    trainings = ran.of("playbyear-train")
    made = {Path(command["output_dir"]).name: int(command["steps"]) for command in trainings}
    assert made[f"OccludedGrasp-v1-full-{further.n_demonstrations}demos-{last.updates}steps-seed1"] == last.updates
    going_on = f"OccludedGrasp-v1-full-control-of-{STEPS}steps-50demos-40steps-seed1"
    alone_on = f"OccludedGrasp-v1-full-50demos-{last.updates}steps-seed1"
    assert (made[going_on] + STEPS if "learn" in options else made[alone_on]) == last.updates


def test_where_the_first_policy_has_as_many_updates_it_is_its_control(ran):
    result = study(updates=STEPS, controls=("updates",)).run()
    assert len(ran.of("playbyear-train")) == 1
    assert result.controls["updates"] == result.outcomes[0]


def test_every_policy_tells_of_its_first_search_and_of_how_its_attempts_ended(ran):
    result = study().run()
    policies = [*result.outcomes, *result.controls.values()]
    assert len(policies) == 5
    for outcome in policies:
        assert (outcome.success, outcome.first_search, outcome.failures) == (50, 25, "25 time, 25 pressed")
        assert outcome.by_contents == "peanuts 25 of 25, screws 25 of 75"
        assert outcome.ends == ["success", "time", "success", "pressed"] * 25


def test_online_goes_on_with_one_run(ran):
    study(learn="online", kept=14, method="robot_gated", controls=()).run()
    commands = ran.of("playbyear-dagger")
    assert [command["episodes"] for command in commands] == ["7", "14"]
    assert len({command["output_dir"] for command in commands}) == 1
    assert all(command["method.type"] == "robot_gated" for command in commands)


@pytest.mark.parametrize("learn", ["new_weights", "online"])
def test_the_papers_course_begins_with_the_easy_bag(ran, learn):
    result = study("KeyBag-Hard-v1", course="paper", kept=40, rounds=1, learn=learn, updates=80, controls=()).run()
    attempts = [command for command in ran.of("playbyear-dagger") if "env.task" in command]
    assert [(command["env.task"], command["episodes"]) for command in attempts] == [
        ("KeyBag-Easy-v1", "12"),
        ("KeyBag-Hard-v1", "40"),
    ]
    assert result.outcomes[-1].kept == 40
    if learn == "online":  # the policy goes from one bag to the next, and takes its updates with it
        assert attempts[0]["output_dir"] in attempts[1]["policy.path"]
        assert result.outcomes[-1].updates == STEPS + 2 * (40 - 4)


def test_online_without_an_update_ends_with_the_first_policy(ran):
    result = study(learn="online", kept=4, rounds=1).run()
    evaluated = [Path(command["policy.path"]) for command in ran.of("lerobot-eval")]
    assert evaluated[0] == evaluated[1] == study().job.checkpoint
    assert [outcome.updates for outcome in (*result.outcomes, *result.controls.values())] == [STEPS] * 4


def test_a_policy_that_needs_no_help_stays_as_it_is(ran):
    ran.needs_no_help = True
    result = study(rounds=1).run()
    last, further = result.outcomes[-1], result.controls["demonstrations"]
    assert (last.updates, last.kept, further.n_demonstrations) == (STEPS, 0, 50)
    assert len(ran.of("playbyear-train")) == 1


def test_the_first_policy_is_that_of_the_ablations(ran):
    job = Job("ablations", "OccludedGrasp-v1", "full", 1)
    assert study().job == job
    protocol.record(job.task, 50)
    training.train(job)
    n = len(ran.told)
    assert trained(study().job) == training.train(job)[0]
    assert len(ran.told) == n


def test_methods_share_what_is_the_same(ran):
    study().run()
    study(method="no_handback").run()
    names = [command["output_dir"] for name in ("playbyear-train", "lerobot-eval") for command in ran.of(name)]
    assert len(names) == len(set(names))
    assert len(ran.of("playbyear-train")) == 3
    assert len(ran.of("lerobot-eval")) == 3 + 2 + 2  # the shared ones, and each method's rounds
    assert len({command["interventions.root"] for command in ran.of("playbyear-dagger")}) == 2


def test_a_policy_of_another_preset_is_not_taken_for_this_one(ran):
    job = study().job
    trained(job)
    path = job.checkpoint / "train_config.json"
    config = json.loads(path.read_text())
    config["policy"]["auxiliary_onset"] = 0.07
    write(path, config)
    with pytest.raises(RuntimeError, match=r"policy.auxiliary_onset was 0.07 and is 0\..* Move it away"):
        trained(job)


def test_two_studies_of_one_seed_wait_for_each_other(ran, monkeypatch):
    at_work, overlaps = [], []

    def train(job):
        overlaps.append(bool(at_work))
        at_work.append(job)
        time.sleep(0.2)  # the other would come by now if nobody kept it out
        at_work.pop()
        return "playbyear-train", 1.0

    monkeypatch.setattr(interactive_parts, "train", train)
    studies = [threading.Thread(target=trained, args=(study().job,)) for _ in range(2)]
    for each in studies:
        each.start()
    for each in studies:
        each.join()
    assert overlaps == [False, False]


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc")
@pytest.mark.parametrize("option", ["--output_dir={}", "--config_path={}/checkpoints/last/train_config.json"])
def test_a_training_that_outlived_its_study_is_waited_for(tmp_path, monkeypatch, option):
    folder = tmp_path / "train" / "policy"
    waits = "import sys; print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", waits, option.format("train/policy")]
    with subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert is_written_to(folder)
        assert not is_written_to(folder.with_name("policy2"))
        monkeypatch.setattr(interactive_parts.time, "sleep", lambda seconds: process.communicate())
        with alone(folder):
            assert process.returncode == 0


def test_options_of_a_training_reach_all_policies_and_their_names(ran):
    option = "--policy.auxiliary_onset=0.7"
    result = study(training_options=[option]).run()
    trainings = ran.of("playbyear-train")
    assert len(trainings) == 3
    assert all(command["policy.auxiliary_onset"] == "0.7" for command in trainings)
    assert all("auxiliary_onset_0.7" in command["output_dir"] for command in ran.of("playbyear-dagger") + trainings)
    learned = [command for command in ran.of("playbyear-dagger") if "new_weights" in command]
    checkpoint = json.loads((Path(learned[-1]["policy.path"]) / "train_config.json").read_text())
    assert checkpoint["policy"]["auxiliary_onset"] == 0.7
    assert result.training_options == [option]
    assert (
        first_job("OccludedGrasp-v1", 1, 50, ["--policy.a=-1"]).name
        != first_job(*("OccludedGrasp-v1", 1, 50, ["--policy.a=1"])).name
    )


def run_main(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["interactive", *arguments])
    interactive.main()


def test_the_command_line_passes_options_of_the_policy_on(ran, monkeypatch):
    run_main(monkeypatch, "--kept=4", "--updates=30", "--policy.auxiliary_onset=0.7", "--controls")
    (result,) = (Path(protocol.RUNS) / "results" / "interactive").glob("*.json")
    assert json.loads(result.read_text())["training_options"] == ["--policy.auxiliary_onset=0.7"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--batch_size=24"], "--batch_size=24 is not passed on"),
        (["--policy.path=x"], "--policy.path=x is not passed on"),
        (["--course=paper"], "is for the bags"),
        (["--task=KeyBag-Hard-v1", "--course=paper", "--kept=20", "--rounds=2"], "give more than 12 a round"),
        (["--kept=1", "--rounds=2"], "give more than 0 a round"),
        (["--learn=online", "--updates=50"], "at least one for every attempt"),
        (["--learn=online", "--grow"], "--grow is for --learn=new_weights"),
    ],
)
def test_what_does_not_go_together_is_refused_before_any_work(ran, monkeypatch, capsys, arguments, message):
    with pytest.raises(SystemExit):
        run_main(monkeypatch, *arguments)
    assert message in capsys.readouterr().err
    assert not ran.told


def test_corrections_learn_from_no_more_demonstrations_than_the_first_policy(ran):
    protocol.record("OccludedGrasp-v1", 100)  # as another study needs them
    root, n_frames = demonstrated("OccludedGrasp-v1", 50)
    assert (root.name, n_frames) == ("OccludedGrasp-v1-50", 50 * DEMONSTRATION_STEPS)


def test_one_training_is_another_ones_control_without_its_expert_steps(ran):
    result = study(controls=("demonstrations",)).run()
    control = result.controls["demonstrations"]
    job = replace(first_job("OccludedGrasp-v1", 1, control.n_demonstrations), steps=30)
    other = interactive.Study(job, Namespace(**DEFAULTS | {"controls": ()})).run()
    assert (control.expert_steps, other.outcomes[0].expert_steps) == (30, 0)
