"""One recording of a whole session, cut into episodes by the times when they began, with the drift of its clock."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from dataset_factory import dataset_features, make_dataset, random_frame
from lerobot.datasets import LeRobotDataset
from test_attach_audio import KEY, RATE, load

from lerobot_playbyear.audio import cut_into_frames, note_episode_start, write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.audio.clock_drift import ClockLine, MarksError, Steady, read_marks
from lerobot_playbyear.audio.recorder_clock import CLOCK_PATH, ClockError, read_clock, read_episode_starts
from lerobot_playbyear.datasets import episode_waveform
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.repair import repair_dataset

FPS, SIZE = 20, RATE // 20
LENGTHS = (100, 40, 200)
CLOCK_BEGINS = 1_754_400_000.0  # when the recorder was started
STARTS = (CLOCK_BEGINS + 3.017, CLOCK_BEGINS + 241.5, CLOCK_BEGINS + 270.25)
CLAPS = (CLOCK_BEGINS + 1.0, CLOCK_BEGINS + 285.0)
FAST = 1.001  # the recorder's clock, against the robot's


@pytest.fixture(scope="module")
def silent(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("silent") / "dataset"
    features = {key: one for key, one in dataset_features().items() if key in ("action", "observation.state")}
    make_dataset(root, LENGTHS, features=features, repo_id="test/silent")
    return root


def taps() -> list[tuple[int, int, float]]:
    """A tap in every third frame: episode, frame, and when, anywhere in the middle nine tenths of the frame's block."""
    rng = np.random.default_rng(0)
    return [
        (episode, frame, STARTS[episode] + (frame - rng.uniform(0.05, 0.95)) / FPS)
        for episode, length in enumerate(LENGTHS)
        for frame in range(1, length, 3)
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Five minutes, recorded by a clock that is 0.1 % fast, of taps 2 ms long."""
    samples = np.random.default_rng(1).normal(0, 20, round(290 * RATE * FAST))
    tap = 12_000 * np.sin(2 * np.pi * 1500 * np.arange(32) / RATE) * np.hanning(32)
    for _, _, clock_s in taps():
        place = round((clock_s - CLOCK_BEGINS) * FAST * RATE)
        samples[place - 16 : place + 16] += tap
    return write_audio(tmp_path_factory.mktemp("session") / "day.flac", samples.astype(np.int16), RATE)


def marks(*clock_s: float) -> str:
    return ", ".join(f"{(moment - CLOCK_BEGINS) * FAST:.6f}={moment:.6f}" for moment in clock_s)


def config(dataset: Path, output: Path, session: Path, **options) -> AttachAudioConfig:
    places = DatasetPlace("test/silent", str(dataset)), DatasetPlace("test/heard", str(output))
    return AttachAudioConfig(*places, **{"session": session, "microphone": "gripper", **options})


def write_clock(folder: Path, starts=STARTS) -> Path:
    path = folder / "starts.csv"
    path.write_text("episode,seconds\n" + "".join(f"{i},{start!r}\n" for i, start in enumerate(starts)))
    return path


def share_in_their_blocks(root: Path) -> float:
    """How many of the taps are loudest in the block of their frame, of all frames within two."""
    dataset = load(root)
    found = 0
    for episode, length in enumerate(LENGTHS):
        energy = np.abs(episode_waveform(dataset, episode, KEY)[0].reshape(length, SIZE)).max(axis=1).astype(float)
        for _, frame, _ in (tap for tap in taps() if tap[0] == episode):
            nearby = range(max(frame - 1, 0), min(frame + 2, length))
            found += max(nearby, key=lambda i: energy[i]) == frame and energy[frame] > 3000
    return found / len(taps())


def test_taps_land_in_the_blocks_of_their_frames_though_the_recorder_is_fast(silent, recording, tmp_path, capsys):
    clock = write_clock(tmp_path)
    root = attach_audio(config(silent, tmp_path / "heard", recording, clock=clock, marks=marks(*CLAPS)))
    assert len(taps()) > 100
    assert share_in_their_blocks(root) >= 0.99
    assert survey(root).is_sound
    assert "+1000 parts in a million" in capsys.readouterr().out

    without = attach_audio(config(silent, tmp_path / "drifting", recording, clock=clock, marks=marks(CLAPS[0])))
    assert share_in_their_blocks(without) < 0.7, "the test would notice nothing without the drift"


def test_times_in_the_dataset_itself_are_taken(silent, recording, tmp_path):
    """Noted while it was recorded; a clap a little off, as a person reads it, costs no tap; an offset is added."""
    shutil.copytree(silent, tmp_path / "noted")
    for episode, start in enumerate(STARTS):
        note_episode_start(tmp_path / "noted", episode, start)
    two = f"{1.0 * FAST + 0.5:.3f}={CLAPS[0]:.3f},{285.0 * FAST + 0.5:.3f}={CLAPS[1]:.3f}"
    cfg = config(tmp_path / "noted", tmp_path / "heard", recording, marks=two, offset=-0.5)
    assert share_in_their_blocks(attach_audio(cfg)) >= 0.99
    assert read_episode_starts(tmp_path / "heard") == dict(enumerate(STARTS))


def test_without_marks_the_seconds_are_those_of_the_file(silent, tmp_path):
    """And not a sample is changed."""
    sound = np.random.default_rng(2).integers(-3000, 3000, 40 * RATE).astype(np.int16)
    session = write_audio(tmp_path / "day.wav", sound, RATE)
    (tmp_path / "starts.json").write_text("[1.5, 10, 12.25]")
    dataset = load(attach_audio(config(silent, tmp_path / "heard", session, clock=tmp_path / "starts.json")))
    for episode, (start, length) in enumerate(zip((1.5, 10, 12.25), LENGTHS, strict=True)):
        wanted = cut_into_frames(sound, RATE, FPS, length, offset=start)
        np.testing.assert_array_equal(episode_waveform(dataset, episode, KEY)[0], wanted.reshape(-1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clock": "1,2\n"}, "has no time for episode 0, 2; the dataset has 3 episodes"),
        ({"clock": "0,a\n"}, "the time of episode 0 is 'a'; wanted seconds"),
        ({"clock": "0,1\n0,2\n"}, "names episode 0 twice"),
        ({"clock": "0 1\n"}, "a line is '0 1'; wanted episode and seconds, such as 0,12.5"),
        ({"clock": None}, r"there is no .*playbyear_clock.json. Give --clock=times.csv"),
        ({"clock": "0,1\n1,2\n2,500\n"}, r"episode 2, which began at 500.000 s of the clock: .*at its end more"),
        ({"marks": "1.0"}, "'1.0' is no mark; wanted seconds in the sound file = seconds on the clock"),
        ({"marks": "1=1,1e999=2"}, "is no mark"),
        ({"marks": "1=5,2=5"}, "the same time on the clock"),
        ({"marks": "10=1,20=5"}, "2.5000 seconds of sound in a second of the clock"),
        ({"session": "missing.wav"}, "There is no sound file"),
        ({"files": "{episode}.wav"}, "both are given. Give one"),
        ({"session": None}, "is for --files and one --session"),
        ({"session": None, "files": "{episode}.wav"}, "--clock=.* is for --session"),
        ({"microphone": "left,right"}, "1 channels, and --microphone names 2"),
    ],
)
def test_what_does_not_fit_is_one_clear_error(silent, tmp_path, options, message):
    folder = tmp_path / "in"
    session = write_audio(folder / "day.wav", np.zeros(30 * RATE, np.int16), RATE)
    (folder / "starts.csv").write_text("0,1\n1,2\n2,3\n")
    options = {"clock": folder / "starts.csv", **options}
    if isinstance(options["clock"], str):
        (folder / "starts.csv").write_text(options["clock"])
        options["clock"] = folder / "starts.csv"
    if isinstance(options.get("session"), str):
        options["session"] = folder / options["session"]
    with pytest.raises(InputError, match=message):
        attach_audio(config(silent, tmp_path / "heard", options.pop("session", session), **options))
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_a_steady_recording_is_the_same_sound_at_the_right_times():
    """A tone of a recorder that is 300 parts in a million slow, below half the sample rate, to 60 dB."""
    for frequency in (440.0, 5000.0):
        drifting = 10_000 * np.sin(2 * np.pi * frequency * np.arange(100_000) / RATE / 0.9997)
        steady = Steady(np.round(drifting).astype(np.int16)[:, None], 0.9997)
        assert len(steady) == int(99_999 / 0.9997) + 1
        wanted = 10_000 * np.sin(2 * np.pi * frequency * np.arange(len(steady)) / RATE)
        got = np.concatenate([steady[:70_001], steady[70_001:]])[:, 0]
        assert np.abs(got - wanted)[50:-50].max() < 10


def test_marks_are_a_line():
    assert read_marks(None) == ClockLine()
    assert read_marks("2.5=100").sound_time(110) == 12.5
    line = read_marks(" 1=101 , 1.5=101.4998, 1001 = 1101 ")
    assert line.speed == pytest.approx(1, abs=1e-6)
    assert 0 < line.error_s < 1e-3
    assert read_marks("1.5=1754400000.5, 3605.1=1754403600.5").speed == pytest.approx(3603.6 / 3600)
    with pytest.raises(MarksError):
        read_marks("")


def test_an_episodes_start_is_noted_and_survives_being_killed(tmp_path):
    """The process is killed again and again while it notes: the file is whole at every moment, and loses nothing."""
    note_episode_start(tmp_path, 0, 1754400000.123456)
    program = (
        "import itertools, sys\nfrom lerobot_playbyear.audio.recorder_clock import note_episode_start\n"
        "print(flush=True)\nfor i in itertools.count(1):\n    note_episode_start(sys.argv[1], i % 50 + 1, i)\n"
    )
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline() == b"\n"
        for _ in range(20):
            starts = read_episode_starts(tmp_path)
            assert starts is not None
            assert starts[0] == 1754400000.123456
        process.kill()
        process.wait()
        assert (read_episode_starts(tmp_path) or {})[0] == 1754400000.123456
    assert json.loads((tmp_path / CLOCK_PATH).read_text())["episodes"]["0"] == 1754400000.123456
    assert read_clock(tmp_path / CLOCK_PATH) == read_episode_starts(tmp_path)


def test_after_a_repair_the_times_are_those_of_the_same_episodes(tmp_path):
    """A killed recording: its second data file is lost, and the episode after it moves up."""
    features = {key: one for key, one in dataset_features().items() if key in ("action", "observation.state")}
    dataset = LeRobotDataset.create("test/lost", FPS, features, root=tmp_path / "lost", use_videos=False)
    dataset.meta.update_chunk_settings(data_files_size_in_mb=1e-6)  # each episode in a file of its own
    rng = np.random.default_rng(0)
    for _ in range(3):
        for _ in range(5):
            dataset.add_frame({**random_frame(features, rng), "task": "Knock."})
        dataset.save_episode()
    dataset.finalize()
    for episode, start in enumerate(STARTS):
        note_episode_start(tmp_path / "lost", episode, start)
    files = sorted((tmp_path / "lost").glob("data/*/*.parquet"))
    assert len(files) == 3
    files[1].unlink()
    target = repair_dataset(tmp_path / "lost").target
    assert read_episode_starts(target) == {0: STARTS[0], 1: STARTS[2]}


def test_a_table_of_times_may_come_from_a_spreadsheet(tmp_path):
    for text in ("0,1.5\n1,20\n", "Episode;Start\n0;1.5\n\n1;20\n", "episode\tstart\tremark\n0\t1.5\t\n1\t20\tgood\n"):
        (tmp_path / "times.csv").write_text(text)
        assert read_clock(tmp_path / "times.csv") == {0: 1.5, 1: 20.0}


def test_no_start_is_noted_through_a_link_or_without_a_meaning(tmp_path):
    outside = tmp_path / "precious.txt"
    outside.write_text("precious")
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/meta/playbyear_clock.partial").symlink_to(outside)
    with pytest.raises(ClockError, match="is a link"):
        note_episode_start(tmp_path / "dataset", 0, 1.0)
    assert outside.read_text() == "precious"
    for index, seconds in ((-1, 1.0), (True, 1.0), (0, float("nan")), (0, "soon")):
        with pytest.raises(ClockError, match="wanted"):
            note_episode_start(tmp_path, index, seconds)  # type: ignore[arg-type]
    assert read_episode_starts(tmp_path) is None
