"""`playbyear-reproduce`: every cell once, whatever is killed; tables, their merging, the report; the plan's commands."""

import json
import os
import random
import re
import shlex
import subprocess
import sys
import time
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from reproduce_factory import arguments, call, counted, rows, write_plan

from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.journal import JOURNAL, STAGING
from lerobot_playbyear.reproduce.plan import Plan, Step
from lerobot_playbyear.reproduce.run import print_plan, print_status
from lerobot_playbyear.reproduce.steps import carry_out
from lerobot_playbyear.reproduce.table import Table, best_rate, told
from lerobot_playbyear.scripts.command import OPTIONS_FILE, find_mistake
from lerobot_playbyear.training.command_line import apply_preset

LISTED = json.loads(OPTIONS_FILE.read_text())
SIZES = ("smoke", "cpu", "gpu", "paper")
N_CELLS = 12  # of the factory's plan: two tasks, three variants, two seeds
N_STEPS = (
    2 + 8 + 4 + 16 + 4 + 12
)  # data, trainings, taught; choice and held-out of `full`, held-out of the others; films


def test_a_cell_is_done_once_and_its_row_says_all(tmp_path):
    write_plan(tmp_path)
    assert call(tmp_path, "run").returncode == 0
    found = rows(tmp_path)
    assert len(found) == N_CELLS
    assert max(Counter(counted(tmp_path)).values()) == 1, "a step that cells share is carried out once"
    row = next(row for row in found if (row["task"], row["variant"], row["seed"]) == ("Grasp", "full", 2))
    assert row["successes"] == "110"  # seeds 100 to 102
    assert row["failures"] == {"dropped": 1}
    assert [point["at"] for point in row["curve"]] == [1, 2]
    assert set(row["best"]) == {"000001", "last"}
    assert best_rate(row) == pytest.approx(200 / 3)
    assert {"commands", "minutes", "versions", "machine", "threads"} <= row.keys()
    before = counted(tmp_path)
    again = call(tmp_path, "run")
    assert (again.returncode, counted(tmp_path)) == (0, before)
    assert f"{N_CELLS} cells of size tiny, {N_CELLS} of them done" in again.stdout


def test_only_does_what_it_names(tmp_path):
    write_plan(tmp_path)
    call(tmp_path, "run", "--only=Grasp/full/seed=1")
    assert [(row["task"], row["variant"], row["seed"]) for row in rows(tmp_path)] == [("Grasp", "full", 1)]
    refused = call(tmp_path, "run", "--only=Grasp/fall")
    assert refused.returncode == 1
    assert "--only=Grasp/fall: no cell of size tiny has these parts. There are Grasp, Place, full," in refused.stderr


def test_killed_at_any_moment_it_goes_on(tmp_path):
    write_plan(tmp_path, seconds=0.05)
    chance, noted = random.Random(0), {}
    for _ in range(10):
        process = subprocess.Popen(arguments(tmp_path, "run", "--jobs=2"), stdout=subprocess.DEVNULL)
        time.sleep(0.5 + 2 * chance.random())
        process.kill()
        process.wait()
        done = {str(path).removesuffix(".done.json") for path in tmp_path.rglob("*.done.json")}
        noted = {step: n for step, n in Counter(counted(tmp_path)).items() if step in done} | noted
    assert call(tmp_path, "run", "--jobs=2").returncode == 0
    assert len(rows(tmp_path)) == N_CELLS
    assert len(noted) > N_CELLS
    times = Counter(counted(tmp_path))
    assert {step: times[step] for step in noted} == noted, "what was noted as done is not done again"


def write_json(path: Path, **content: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def test_a_recording_that_was_killed_while_its_last_episode_was_moved_is_whole(tmp_path):
    folder = tmp_path / "data"
    write_json(folder / "meta/info.json", total_episodes=1)
    write_json(folder / STAGING / "meta/info.json", total_episodes=2)
    (folder / JOURNAL).touch()
    carry_out(Step("record", folder, ("playbyear-record", "--dataset.num_episodes=2")))
    assert json.loads((folder / "meta/info.json").read_text()) == {"total_episodes": 2}


def test_a_training_that_was_killed_before_its_checkpoint_was_linked_is_done(tmp_path):
    checkpoints = tmp_path / "train/checkpoints"
    for step in (2, 4):
        write_json(checkpoints / f"00000{step}/pretrained_model/train_config.json")
        write_json(checkpoints / f"00000{step}/training_state/training_step.json", step=step)
        write_json(checkpoints / f"00000{step}/training_state/optimizer_param_groups.json")  # LeRobot's last
    carry_out(Step("train", tmp_path / "train", ("playbyear-train", "--steps=4")))
    assert (checkpoints / "last").resolve() == checkpoints / "000004"


def test_two_runs_at_once_never_do_one_cell_twice(tmp_path):
    write_plan(tmp_path, seconds=0.05)
    both = [subprocess.Popen(arguments(tmp_path, "run"), stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    told = re.findall(r"^(parts/\S+): ", "\n".join(said), re.MULTILINE)
    assert (len(told), len(set(told))) == (N_CELLS, N_CELLS)
    assert max(Counter(counted(tmp_path)).values()) == 1


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a disk that is full")
def test_a_fork_that_cannot_say_anything_ends_all_the_same():
    program = """
import os, sys
from lerobot_playbyear.reproduce.steps import forked
sys.stdout = open("/dev/full", "w")
try:
    os.waitpid(forked(lambda: print("said") or 0), 0)
finally:
    os.write(2, b"one process is here\\n")
"""
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False)
    assert done.stderr.count("one process is here") == 1


def test_what_failed_is_told_and_tried_again(tmp_path):
    write_plan(tmp_path, kind="fails", n_seeds=1)
    failed = call(tmp_path, "run")
    assert failed.returncode == 1
    assert "it is broken" in failed.stdout
    assert "6 cells failed" in failed.stderr
    assert "6 failed" in call(tmp_path, "status").stdout
    (tmp_path / "out/tiny/train").mkdir(parents=True, exist_ok=True)
    (tmp_path / "out/tiny/train/mended").touch()
    assert call(tmp_path, "run").returncode == 0
    assert "6 done" in call(tmp_path, "status").stdout


def test_what_another_plan_has_made_is_not_taken_for_its_own(tmp_path):
    write_plan(tmp_path, n_seeds=1)
    call(tmp_path, "run", "--only=Grasp/no_audio")
    write_plan(tmp_path, seconds=0.01, n_seeds=1)
    assert (
        "was made by another command than the plan's" in call(tmp_path, "run", "--only=Grasp/no_interventions").stdout
    )


def test_another_machines_rows_are_taken_in_and_none_is_lost(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder, only in ((here, "seed=1"), (there, "Grasp")):
        folder.mkdir()
        write_plan(folder)
        call(folder, "run", f"--only={only}")
    own = rows(here)
    merged = call(here, "merge", str(there / "results"))
    assert "3 rows taken in" in merged.stdout
    assert len(rows(here)) == 9
    assert all(row in rows(here) for row in own), "a row that is there stays as it is"
    assert "0 rows taken in" in call(here, "merge", str(there / "results")).stdout
    assert "holds no rows" in call(here, "merge", str(tmp_path / "nothing")).stderr


def test_a_damaged_table_is_named(tmp_path):
    (tmp_path / "parts.jsonl").write_text('{"study": "parts"\n')
    with pytest.raises(InputError, match=r"parts.jsonl:1 is damaged"):
        Table(tmp_path).rows()


def test_the_plan_of_every_size_reads_the_committed_tables(capsys):
    for size in SIZES:
        cells, table = Plan(size, Path("out")).cells, Table(Path(__file__).parents[1] / "results")
        print_plan(cells, table)
        print_status(cells, table)
        assert f"{len(cells)} cells" in capsys.readouterr().out


def test_who_acted_early_is_told_where_the_task_tells_it_of_every_attempt(tmp_path):
    path, attempt = tmp_path / "attempts.jsonl", {"is_success": True, "end": "success"}
    lines = [attempt | {"seed": 1, "acted_early": True}, attempt | {"seed": 2}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert told(path, 1, 1)["acted_early"] == "1"
    assert "acted_early" not in told(path, 1, 2)


def test_an_attempt_that_is_missing_is_told_with_all_that_is_to_be_removed(tmp_path):
    path = tmp_path / "held_out-train-last/attempts.jsonl"
    with pytest.raises(InputError, match=rf"Remove {path.parent} and {path.parent}.done.json\."):
        told(path, 1, 1)


def test_a_strangers_row_names_no_other_file(tmp_path):
    there, row = tmp_path / "there", {"task": "t", "variant": "v", "seed": 1, "size": "cpu"}
    there.mkdir()
    (there / "parts.jsonl").write_text(json.dumps(row | {"study": "../outside"}) + "\n")
    with pytest.raises(InputError, match=r"its study is '../outside', wanted 'parts'"):
        Table(tmp_path / "here").merge(Table(there))
    assert not (tmp_path / "outside.jsonl").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"task": ["x"]},
        {"successes": 5},
        {"machine": 5},
        {"minutes": {"record": "x"}},
        {"curve": [{"at": 1}]},
        {"players": {"expert": {"kind": "expert"}}},
    ],
)
def test_a_strangers_row_that_no_page_can_show_is_named_and_not_taken_in(tmp_path, wrong):
    row = {"study": "parts", "task": "t", "variant": "v", "seed": 1, "size": "cpu", "commands": []}
    (tmp_path / "parts.jsonl").write_text(json.dumps(row | wrong) + "\n")
    with pytest.raises(InputError, match=r"parts.jsonl:1 is damaged: "):
        Table(tmp_path / "here").merge(Table(tmp_path))


def test_a_row_without_figures_is_shown(tmp_path):
    write_plan(tmp_path)
    (tmp_path / "results").mkdir()
    row = {"study": "parts", "task": "Grasp", "variant": "full", "seed": 1, "size": "tiny"}
    (tmp_path / "results/parts.jsonl").write_text(json.dumps(row) + "\n")
    assert call(tmp_path, "report").returncode == 0
    assert "1 of 12 cells are done" in (tmp_path / "out/tiny/report.md").read_text()


def test_a_strangers_names_do_nothing_on_a_page_or_in_a_terminal(tmp_path):
    row = {"study": "parts", "task": "Grasp", "variant": "full", "seed": 1, "size": "tiny"}
    row["players"] = {"<b>|": {"kind": "expert", "successes": 1, "n_episodes": 2}}
    row["machine"] = {"processor": "[fast](http://x)"}
    (tmp_path / "results").mkdir()
    (tmp_path / "results/parts.jsonl").write_text(json.dumps(row) + "\n")
    path = write_plan(tmp_path)
    plan = yaml.safe_load(path.read_text())
    plan["steps"]["train"]["command"] += " \x1b[2K"
    plan["studies"]["parts"]["tasks"]["\x1b[2K"] = {}
    path.write_text(yaml.safe_dump(plan))
    assert call(tmp_path, "report").returncode == 0
    text = (tmp_path / "out/tiny/report.md").read_text()
    assert r"| \<b\>\| (expert) 50 % |" in text
    assert r"cells on \[fast\](http\://x)" in text
    said = [call(tmp_path, action) for action in ("plan", "status")]
    assert [each.returncode for each in said] == [0, 0]
    assert "\x1b" not in said[0].stdout + said[1].stdout
    assert r"parts/\x1b[2K/full" in said[0].stdout


class _Page(HTMLParser):
    """What a page asks of others."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.asked += [
            str(value) for name, value in attrs if name in ("src", "href") and not str(value).startswith("data:")
        ]


def test_the_report_shows_what_there_is_and_says_what_is_missing(tmp_path):
    write_plan(tmp_path)
    call(tmp_path, "run", "--only=Grasp/full,Grasp/no_audio/seed=1")
    assert call(tmp_path, "report").returncode == 0
    text = (tmp_path / "out/tiny/report.md").read_text()
    assert "3 of 12 cells are done" in text
    assert r"| full | 67 ± 0 %; first 2 episodes\: 2, 2 | 67 ± 0 % | 33 ± 0 % | 100 ± 0 % | 2 of 2 | 70 % |" in text
    assert "| no_interventions | not run |  |  |  | 0 of 2 |  |" in text
    assert "| failures of the last checkpoint | dropped |" in text
    page = _Page()
    page.feed((tmp_path / "out/tiny/report.html").read_text())
    assert page.asked == []
    drawn = (tmp_path / "out/tiny/report.html").read_text()
    assert drawn.count("<svg") == 2  # bars and curves of the one task
    assert drawn.count("not run") == 4


def commands_of(size: str) -> dict[str, tuple[str, ...]]:
    """All commands of a size, by their text."""
    found = {}
    for cell in Plan(size, Path("out")).cells:
        tried = [cell.evaluation(purpose, each) for purpose in ("choice", "held_out") for each in cell.candidates]
        films = [cell.film("dropped", 3)] if cell.candidates else []
        for step in (*cell.steps, *tried, *films):
            found[step.shown] = step.command
    return found


@pytest.mark.parametrize("size", SIZES)
def test_the_plans_commands_have_options_that_exist(size):
    commands = commands_of(size)
    assert len({command[0] for command in commands.values()}) == 6
    for text, (name, *options) in commands.items():
        if name in LISTED and name.startswith("playbyear-"):
            given = apply_preset(options) if name == "playbyear-train" else options
            assert find_mistake(given, LISTED[name], LISTED["policies"]) is None, text
        assert "$" not in text
        assert shlex.split(text) == [name, *options], "as it is shown it can be typed"


@pytest.mark.parametrize("size", SIZES)
def test_no_two_commands_write_into_one_folder(size):
    """But for the attempts of the bag's second part, which are appended to those of the first."""
    folders: dict[Path, str] = {}
    for cell in Plan(size, Path("out")).cells:
        for step in cell.steps:
            assert folders.setdefault(step.folder, step.shown) == step.shown


def test_demonstrations_attempts_choices_and_scores_share_no_seed():
    seeds = Plan("paper", Path("out")).text["seeds"]
    ranges = [range(first, first + 2000) for first in seeds.values()]
    assert all(not set(one) & set(other) for i, one in enumerate(ranges) for other in ranges[:i])


def test_jobs_of_submitit_do_the_same(tmp_path):
    """Its local executor, a process for each cell, runs the code that its Slurm executor submits; no cluster was at hand."""
    pytest.importorskip("submitit")
    write_plan(tmp_path, n_seeds=1)
    done = call(tmp_path, "run", "--cluster=local", "--only=Grasp/full,Place/no_audio", "--jobs=2")
    assert done.returncode == 0, done.stderr
    assert {(row["task"], row["variant"]) for row in rows(tmp_path)} == {("Grasp", "full"), ("Place", "no_audio")}
    assert max(Counter(counted(tmp_path)).values()) == 1


def test_an_output_folder_may_have_any_name(tmp_path):
    write_plan(tmp_path)
    folder = tmp_path / "it's my $out"
    done = call(tmp_path, "run", "--only=Grasp/no_interventions/seed=1", f"--output_dir={folder}")
    assert done.returncode == 0, done.stderr + done.stdout
    assert counted(tmp_path)[:2] == [str(folder / "tiny/data/Grasp"), str(folder / "tiny/train/Grasp-full-1")]


@pytest.mark.parametrize("name", ["/$task", "../..", "data/../..", ""])
def test_a_folder_that_leads_out_of_the_outputs_is_refused(tmp_path, name):
    path = write_plan(tmp_path)
    plan = yaml.safe_load(path.read_text())
    plan["steps"]["train"]["folder"] = name
    path.write_text(yaml.safe_dump(plan))
    refused = call(tmp_path, "run")
    assert refused.returncode == 1
    assert f"'{name.replace('$task', 'Grasp')}' is no folder below {tmp_path / 'out/tiny'}" in refused.stderr
    assert not (tmp_path / "count").exists()


@pytest.mark.parametrize(
    ("where", "content"),
    [
        ("studies/parts/seeds", [1]),
        ("studies/parts/tasks", 3),
        ("courses/offline", ["records"]),
        ("steps/train", "train"),
    ],
)
def test_a_plan_of_another_shape_is_refused_before_anything_is_done(tmp_path, where, content):
    path = write_plan(tmp_path)
    plan = yaml.safe_load(path.read_text())
    *sections, last = where.split("/")
    part = plan
    for section in sections:
        part = part[section]
    assert last in part or last == "seeds"
    part[last] = content
    path.write_text(yaml.safe_dump(plan))
    with pytest.raises(InputError, match=r"is not built as those of the package's plan.yaml"):
        Plan("tiny", tmp_path / "out", path)


def test_without_submitit_a_cluster_is_refused(tmp_path):
    write_plan(tmp_path)
    (tmp_path / "submitit.py").write_text("raise ImportError('blocked')\n")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    refused = call(tmp_path, "run", "--cluster=local", environment={"PYTHONPATH": path})
    assert refused.returncode == 1
    assert "pip install 'lerobot_policy_playbyear[cluster]'" in refused.stderr
