"""What the benchmarks compare with is what they say, and their figures and tables are put together rightly."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from support.policy import make_config

from lerobot_playbyear.policy.modeling_playbyear import PlaybyearPolicy

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(autouse=True)
def benchmarks_on_path(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_the_published_scheme_gives_our_actions_for_the_same_weights():
    """Encoding ten frames per window anew is slower, and not something else."""
    from reference import Reference, random_windows

    torch.manual_seed(0)
    config = make_config(
        image_size=224,
        vision_width=64,
        hidden_size=1024,
        normalize_encodings=False,
        low_dimensional_gain=1.0,
        n_supervised_steps=1,
    )
    policy = PlaybyearPolicy(config).eval()
    reference = Reference().eval()
    reference.load_from(policy.model.state_dict())
    images, sound, state, _ = random_windows(2)
    batch = {
        "observation.images.front": images,
        "observation.audio.gripper": sound.view(2, -1, 800),
        "observation.state": state,
    }
    with torch.no_grad():
        torch.testing.assert_close(reference(images, sound, state), policy.predict_run(batch)[:, 0], rtol=0, atol=1e-4)


def test_the_references_augmentation_moves_and_colours_a_little():
    from reference import augment

    image = torch.rand(1, 3, 84, 84).expand(3, 3, 84, 84)
    augmented = augment(image)
    assert augmented.shape == image.shape
    assert (augmented == augmented[:1]).all()
    assert 0.01 < (augmented - image).abs().mean() < 0.5


def test_work_is_timed_in_turns_and_warm_up_does_not_count():
    from common import in_turns

    calls: list[str] = []
    seconds = in_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, n_turns=3, warm_up=2)
    assert calls == ["a", "b"] * 5
    assert [len(values) for values in seconds.values()] == [3, 3]


def test_figures_are_merged_and_printed(tmp_path, capsys):
    from common import Row, machine, report, rows_of
    from run import print_table

    output = tmp_path / "bench.json"
    fast = Row("steps", 500.0, "steps/s", "other", 20.0, wanted="at least 250", holds=True)
    slow = Row("latency", 40.0, "ms", "other", 80.0, "alone", 30.0, "at most 35 ms", False)
    report("environment", [fast], output, machine())
    report("acting", [slow], output, machine())
    assert fast.times_better == 25
    assert slow.times_better == 2
    assert rows_of(json.loads(output.read_text())["acting"]) == [slow]
    capsys.readouterr()
    print_table(output)
    table = capsys.readouterr().out
    assert "| steps | 500 steps/s | other: 20 | 25 |  | at least 250: holds |" in table
    assert "| latency | 40 ms | other: 80 | 2 | alone: 30 | at most 35 ms: **does not hold** |" in table


def test_a_helper_answers_and_tells_why_it_cannot():
    from common import Helper

    code = (
        f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r}); from common import serve; serve(lambda q: 2 * float(q))"
    )
    helper = Helper(sys.executable, "-c", code)
    assert [helper.measure("3"), helper.measure("4")] == [6, 8]
    helper.close()
    with pytest.raises(RuntimeError, match="no such thing"):
        Helper(sys.executable, "-c", "raise SystemExit('no such thing')").measure()


@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory are Linux's")
@pytest.mark.parametrize(
    ("work", "wanted"),
    [
        ("b = bytearray(200 << 20); b[::4096] = b'1' * len(b[::4096]); import time; time.sleep(1)", ""),
        ("b = bytearray(2000 << 20)", "status 1: MemoryError"),
        ("raise SystemExit('nothing there')", "status 1: nothing there"),
    ],
)
def test_the_memory_of_a_command_is_limited_and_measured(tmp_path, work, wanted):
    from memory import GIB, measure, table

    result = measure("work", [sys.executable, "-c", work], 1, GIB, {"HF_HOME": str(tmp_path / "home")})
    assert result.failure == wanted
    if not wanted:
        assert 0.19 < result.own_gib <= result.peak_gib < 0.4
        assert result.seconds >= 1
    assert ("**failed**" in table([result])[-1]) == bool(wanted)


@pytest.mark.slow
def test_every_command_reads_an_episode_as_the_memory_benchmark_makes_it(tmp_path):
    from memory import COMMANDS, GIB, run

    results = run(tmp_path, 0.05, 4 * GIB, None, tmp_path / "bench.json")
    assert [result.command for result in results] == list(COMMANDS)
    assert [result.failure for result in results] == [""] * len(COMMANDS)
    assert json.loads((tmp_path / "bench.json").read_text())["memory"].keys() == COMMANDS.keys()


def test_a_command_is_timed_up_to_the_first_of_its_files(tmp_path):
    """That none of them ends otherwise, the benchmark checks itself."""
    from startup import make_inputs, rows, works

    make_inputs(tmp_path)
    timed = works(tmp_path)
    for name in (
        "playbyear-inspect, to its first work",
        "playbyear-inspect --help",
        "playbyear-push with a misspelt option",
    ):
        timed[name]()
    table = rows(dict.fromkeys(timed, 3.0))
    assert len(table) == len(timed) - 1
    assert {row.what for row in table if row.holds} == {row.what for row in table if "first work" in row.what}


@pytest.mark.slow
def test_the_benchmark_for_gpus_runs_without_one(tmp_path):
    """Every part of it, with two demonstrations and a network that learns nothing in three updates."""
    options = (
        "--steps=3 --batch_size=2 --policy.image_size=32 --policy.vision_width=8 --policy.n_supervised_steps=4 "
        "--policy.hidden_size=64 --compile=false --save_freq=3"
    )
    small = ("--device=cpu", "--demos=2", "--rounds=1", "--evaluations=2", f"--options={options}")
    output = tmp_path / "bench.json"
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), *small, f"--output={output}"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-3000:]
    rows = {row["what"]: row for row in json.loads(output.read_text())["gpu"]["rows"]}
    operations = rows["operations of an update over its time"]
    assert 0 < operations["ours"] < operations["limit"]
    assert rows["a round of HG-DAgger"]["ours"] > 0
    assert 0 <= rows["success on 2 episodes"]["ours"] <= 100


def test_the_benchmark_for_gpus_says_that_there_is_none(monkeypatch):
    import gpu

    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match="no NVIDIA GPU here; --device=cpu"):
        gpu.main()
