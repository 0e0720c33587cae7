"""`playbyear-inspect`: every fault is found where it is, and a sound dataset has none."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from support.recording import edit_column, edit_info
from support.shared import run_in_process

from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.features import audio_feature
from lerobot_playbyear.inspection import Finding
from lerobot_playbyear.inspection.inspect import InspectConfig, InspectDatasetConfig, inspect
from lerobot_playbyear.inspection.sound import flat_tops, gaps, repeats
from lerobot_playbyear.scripts.commands import inspect as main

FPS, SAMPLE_RATE, SIZE = 20, 16000, 32
BLOCK = SAMPLE_RATE // FPS
EPISODES, LENGTH = 3, 40
TOUCH = 25  # the frame in which the arm touches something
CAMERA, MICROPHONE = "observation.images.front", "observation.audio.gripper"

Arrays = dict[str, np.ndarray]


def features(sound: bool = True) -> dict[str, dict[str, Any]]:
    scalar = {"shape": (1,), "names": None}
    return {
        CAMERA: {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]},
        **({MICROPHONE: audio_feature(SAMPLE_RATE, FPS)} if sound else {}),
        "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
        "intervention": {"dtype": "bool", **scalar},
        "next.success": {"dtype": "bool", **scalar},
    }


def clean_episode(rng: np.random.Generator) -> Arrays:
    """An arm that moves, touches something (which is heard and stops it), and moves on; what it sees moves with it."""
    sound = rng.normal(0, 30, LENGTH * BLOCK)
    touch = TOUCH * BLOCK + 100
    sound[touch : touch + 800] += rng.normal(0, 6000, 800) * np.exp(-np.arange(800) / 200)
    speed = np.full(LENGTH, 0.02)
    speed[TOUCH] = -0.2
    state = np.cumsum(speed)[:, None] * [1.0, 0.5, -1.0] + rng.normal(0, 1e-4, (LENGTH, 3))
    pictures = np.full((LENGTH, SIZE, SIZE, 3), 90, np.uint8)
    for t in range(LENGTH):
        pictures[t, :, t % SIZE] = 250
        pictures[t, t // SIZE, :, 0] = 10
    return {
        CAMERA: pictures,
        MICROPHONE: sound.clip(-32768, 32767).astype(np.int16).reshape(LENGTH, BLOCK),
        "observation.state": state.astype(np.float32),
        "action": rng.uniform(-1, 1, (LENGTH, 2)).astype(np.float32),
        "intervention": np.ones((LENGTH, 1), bool),
        "next.success": (np.arange(LENGTH) == LENGTH - 1)[:, None],
    }


def write(root: Path, episodes: list[Arrays], keys: dict[str, dict[str, Any]] | None = None) -> Path:
    """A dataset of these episodes."""
    keys = keys or features()
    with DurableWriter("tests/inspected", root, FPS, keys) as writer:
        for arrays in episodes:
            for t in range(len(arrays["action"])):
                writer.add_frame({**{key: arrays[key][t] for key in keys}, "task": "touch it"})
            writer.save_episode()
    return root


def clean_episodes(n: int) -> list[Arrays]:
    rng = np.random.default_rng(0)
    return [clean_episode(rng) for _ in range(n)]


def look(root: Path, **options: Any) -> list[Finding]:
    return inspect(InspectConfig(InspectDatasetConfig("tests/inspected", str(root)), **options))


def found(verdicts: list[Finding]) -> dict[str, Finding]:
    """All warnings and errors, by check."""
    return {verdict.check: verdict for verdict in verdicts if verdict.level in ("warning", "error")}


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("clean") / "dataset", clean_episodes(EPISODES))


@pytest.fixture
def root(clean, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(clean, tmp_path / "copy"))


def test_a_sound_dataset_passes_every_check(clean, capsys):
    verdicts = look(clean)
    assert found(verdicts) == {}
    printed = capsys.readouterr().out
    for check in ("rows", "times", "statistics", "sample rate", "clipping", "drop-outs", "frames that repeat"):
        assert any(line.startswith("ok") and f" {check} " in line for line in printed.splitlines()), check
    assert "tests/inspected" in printed
    assert f"{EPISODES} episodes, {EPISODES * LENGTH} frames" in printed


# One fault each


def dead_microphone(a: Arrays) -> None:
    a[MICROPHONE][:] = 0


def quiet_microphone(a: Arrays) -> None:
    a[MICROPHONE][:] = a[MICROPHONE] % 2


def clipped(a: Arrays) -> None:
    a[MICROPHONE][:] = (a[MICROPHONE].astype(int) * 12).clip(-32768, 32767)


def overloaded_before_full_scale(a: Arrays) -> None:
    a[MICROPHONE][:] = a[MICROPHONE].clip(-3000, 3000)


def offset(a: Arrays) -> None:
    a[MICROPHONE] += 1000


def dropped_out(a: Arrays) -> None:
    a[MICROPHONE][10, 200:300] = 0


def stale_block(a: Arrays) -> None:
    a[MICROPHONE][12] = a[MICROPHONE][11]


def stale_driver_block(a: Arrays) -> None:
    wave = a[MICROPHONE].reshape(-1)
    wave[5000 + 256 : 5000 + 512] = wave[5000 : 5000 + 256]


def frozen_camera(a: Arrays) -> None:
    a[CAMERA][5:30] = a[CAMERA][5]


def blank_picture(a: Arrays) -> None:
    a[CAMERA][7] = 0


def large_action(a: Arrays) -> None:
    a["action"][9, 1] = 1.5


FAULTS: dict[Callable[[Arrays], None], tuple[str, str]] = {
    dead_microphone: ("silence", "error"),
    quiet_microphone: ("silence", "warning"),
    clipped: ("clipping", "warning"),
    overloaded_before_full_scale: ("clipping", "warning"),
    offset: ("DC offset", "warning"),
    dropped_out: ("drop-outs", "warning"),
    stale_block: ("repeated blocks", "warning"),
    stale_driver_block: ("repeated blocks", "warning"),
    frozen_camera: ("frames that repeat", "error"),
    blank_picture: ("blank pictures", "warning"),
    large_action: ("action range", "warning"),
}


@pytest.fixture(scope="module")
def faulty(tmp_path_factory) -> list[Finding]:
    """What is said of a dataset whose episode i has the i-th fault."""
    episodes = clean_episodes(len(FAULTS) + 1)
    for spoil, arrays in zip(FAULTS, episodes, strict=False):
        spoil(arrays)
    return look(write(tmp_path_factory.mktemp("faulty") / "dataset", episodes))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_a_fault_is_found_in_its_episode(faulty, fault):
    check, level = FAULTS[fault]
    episode = list(FAULTS).index(fault)
    assert [v.level for v in faulty if v.check == check and episode in v.episodes] == [level]


def test_nothing_is_found_where_there_is_no_fault(faulty):
    said = {(verdict.check, episode) for verdict in faulty for episode in verdict.episodes}
    assert said == {(check, episode) for episode, (check, _) in enumerate(FAULTS.values())}


def test_many_faults_are_errors_where_few_are_warnings(tmp_path):
    episodes = clean_episodes(2)
    episodes[1][MICROPHONE][10:20, 200:300] = 0
    episodes[1][CAMERA][1::2] = episodes[1][CAMERA][0::2]
    episodes[0]["action"][:, 0] = episodes[1]["action"][:, 0] = 0.25
    levels = {check: verdict.level for check, verdict in found(look(write(tmp_path / "dataset", episodes))).items()}
    assert levels == {"drop-outs": "error", "frames that repeat": "warning", "actions used": "warning"}


@pytest.mark.parametrize(("rate", "known", "said"), [(48000, 48000, "it must be (2400,)"), (float("nan"), None, "nan")])
def test_a_sample_rate_that_does_not_fit_or_is_no_number_is_an_error_and_all_else_is_checked(
    root, tmp_path, capsys, rate, known, said
):
    """What is printed and the page are valid JSON, whatever the dataset says."""
    page = tmp_path / "page.html"
    edit_info(root, lambda info: info["features"][MICROPHONE]["info"].update(sample_rate=rate))
    assert run(f"--dataset.root={root}", f"--html={page}", "--json") == 1
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert printed["dataset"]["microphones"] == {MICROPHONE: known}
    checks = {verdict["check"]: verdict for verdict in printed["verdicts"]}
    told = checks["sample rate"]
    assert (told["level"], told["feature"], said in told["message"]) == ("error", MICROPHONE, True)
    assert "clipping" not in checks
    assert "frames that repeat" in checks
    data = re.search(r'id="dataset">(.*?)</script>', page.read_text())[1]
    assert json.loads(data, parse_constant=pytest.fail)["facts"]["microphones"] == {MICROPHONE: known}


def test_statistics_of_other_data_are_an_error(root):
    edit_info(root, lambda stats: stats["action"].update(mean=[0.5, 0.5]), "stats.json")
    verdict = found(look(root))["statistics"]
    assert verdict.level == "error"
    assert "action (mean[0] is 0.5 there" in verdict.message
    assert "recompute_stats" in verdict.message


def change(root: Path, key: str, row: int, value: Any) -> None:
    """Another value in a column of the data; `value` may be a function of the one that is there."""
    (path,) = root.glob("data/*/*.parquet")
    put = value if callable(value) else lambda _: value
    edit_column(path, key, lambda values: [*values[:row], put(values[row]), *values[row + 1 :]])


def test_frames_that_the_metadata_does_not_know_of_are_an_error(root):
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    pq.write_table(table.filter(pc.not_equal(table["index"], LENGTH + 7)), path)
    verdict = found(look(root))["rows"]
    assert (verdict.level, list(verdict.episodes)) == ("error", [1])


def test_nan_is_named_and_the_other_checks_go_on(clean, root, tmp_path):
    change(root, "observation.state", LENGTH + 3, lambda state: [state[0], float("nan"), state[2]])
    verdicts = look(root, html=tmp_path / "page.html")
    faults = found(verdicts)
    assert list(faults) == ["finite numbers"]
    assert (faults["finite numbers"].level, faults["finite numbers"].feature) == ("error", "observation.state")
    assert list(faults["finite numbers"].episodes) == [1]
    assert len(verdicts) == len(look(clean))


@pytest.mark.parametrize("keys", [["observation.state", MICROPHONE], ["action", "intervention", "next.success"]])
def test_columns_that_lack_a_value_are_named_and_the_other_checks_go_on(root, tmp_path, keys):
    for key in keys:
        change(root, key, LENGTH + 3, None)
    verdicts = look(root, html=tmp_path / "page.html")
    faults = [verdict for verdict in verdicts if verdict.level in ("warning", "error")]
    assert {(fault.check, fault.level, fault.feature) for fault in faults} == {
        ("columns", "error", key) for key in keys
    }
    checks = {verdict.check for verdict in verdicts}
    assert {"rows", "finite numbers", "statistics", "pictures", "frames that repeat"} <= checks
    assert (tmp_path / "page.html").stat().st_size > 10_000


def test_a_damaged_picture_is_an_error_and_the_page_is_written_all_the_same(root, tmp_path):
    change(root, CAMERA, LENGTH + 30, lambda picture: {**picture, "bytes": picture["bytes"][:60]})
    verdict = found(look(root, html=tmp_path / "page.html"))["pictures"]
    assert (verdict.level, list(verdict.episodes)) == ("error", [1])
    assert (tmp_path / "page.html").stat().st_size > 10_000


def test_interventions_and_success_are_counted(tmp_path):
    episodes = clean_episodes(2)
    for arrays in episodes:
        arrays["intervention"][:] = False
    episodes[0]["intervention"][5:10] = episodes[0]["intervention"][30:35] = True
    episodes[1]["next.success"][:] = False
    verdicts = {verdict.check: verdict for verdict in look(write(tmp_path / "dataset", episodes))}
    assert verdicts["interventions"].figures == {"share": 10 / 80, "spans": 2, "episodes_without": 1}
    assert verdicts["success"].figures == {"succeeded": 1, "episodes": 2}
    assert list(verdicts["success"].episodes) == [1]


def test_a_dataset_without_sound_or_cameras_says_so(tmp_path):
    keys = {key: feature for key, feature in features(sound=False).items() if key != CAMERA}
    verdicts = look(write(tmp_path / "dataset", clean_episodes(2), keys))
    assert found(verdicts) == {}
    messages = {verdict.check: verdict.message for verdict in verdicts}
    assert messages["sound"].startswith("no sound")
    assert messages["pictures"] == "no camera"


# The detectors, on sound that is hard to judge


def tapped(rng: np.random.Generator, delay_s: float) -> Arrays:
    """Five taps of a hand that comes for 0.2 s and stops, seen at once and heard later; the row ends with its picture."""
    length = 5 * 16 + 10
    taps = 0.6 + 0.8 * np.arange(5) + rng.uniform(0, 0.1, 5)
    places = np.clip((np.arange(length)[:, None] / FPS - taps) / 0.2 + 1, 0, 1).sum(axis=1)  # of the hand
    sound = rng.normal(0, 10, length * BLOCK)
    for tap in taps:
        start = round((tap + delay_s + 1 / FPS) * SAMPLE_RATE)
        sound[start : start + 800] += rng.normal(0, 6000, 800) * np.exp(-np.arange(800) / 200)
    pictures = np.clip(SIZE * places[:, None] / 5 - np.arange(SIZE), 0, 1) * 200  # (length, SIZE)
    return {
        CAMERA: np.broadcast_to(pictures[:, None, :, None], (length, SIZE, SIZE, 3)).astype(np.uint8),
        MICROPHONE: sound.clip(-32768, 32767).astype(np.int16).reshape(length, BLOCK),
        "observation.state": rng.normal(size=(length, 3)).astype(np.float32),
        "action": rng.uniform(-1, 1, (length, 2)).astype(np.float32),
        "intervention": np.ones((length, 1), bool),
        "next.success": np.ones((length, 1), bool),
    }


@pytest.mark.parametrize("delay_s", [0.038, -0.03])
def test_how_much_later_sound_comes_than_the_picture_is_told_from_taps(tmp_path, capsys, delay_s):
    rng = np.random.default_rng(0)
    verdicts = look(write(tmp_path / "data", [tapped(rng, delay_s) for _ in range(3)]))
    (told,) = [verdict for verdict in verdicts if verdict.check == "sound and picture"]
    assert told.figures["delay_s"] == pytest.approx(delay_s, abs=0.006)
    assert told.figures["contacts"] >= 14
    side = "after" if delay_s > 0 else "before"
    assert re.search(rf"sound comes \d+ ms {side} the picture of {CAMERA} \(spread \d+ ms", capsys.readouterr().out)


def test_where_sounds_are_no_contacts_nothing_is_said_of_sound_and_picture(tmp_path):
    rng = np.random.default_rng(0)
    episodes = [tapped(rng, 0.0) for _ in range(3)]
    for episode, rows in zip(episodes, (3, 7, 11), strict=True):
        episode[MICROPHONE] = np.roll(episode[MICROPHONE], rows, axis=0)
    verdicts = look(write(tmp_path / "data", episodes))
    assert not [verdict for verdict in verdicts if verdict.check == "sound and picture"]


def test_quiet_sound_of_few_steps_is_neither_cut_nor_lost():
    samples = np.round(np.random.default_rng(0).normal(0, 0.6, 5 * SAMPLE_RATE))  # half of the samples are 0
    assert gaps(samples, SAMPLE_RATE) == flat_tops(samples) == repeats(samples, BLOCK) == []


def test_silence_before_and_after_the_sound_is_no_gap():
    samples = np.zeros(SAMPLE_RATE)
    samples[4000:8000] = np.random.default_rng(0).normal(0, 500, 4000).round()
    assert gaps(samples, SAMPLE_RATE) == []
    samples[6000:6064] = 0
    assert gaps(samples, SAMPLE_RATE) == [(6000, 6064)]


# The command


def run(*arguments: str) -> int:
    return int(run_in_process(main, "--dataset.repo_id=tests/inspected", *arguments) or 0)


def test_the_commands_status_says_whether_there_is_an_error(clean, capsys):
    assert run(f"--dataset.root={clean}", "--json", "--dataset.episodes=[1]") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["worst"] in ("ok", "info")
    assert {"check", "level", "message", "feature", "episodes", "figures"} == set(printed["verdicts"][0])
    assert run(f"--dataset.root={clean}", "--action_range=[-0.5, 0.5]") == 1
    assert "error    action range" in capsys.readouterr().out
