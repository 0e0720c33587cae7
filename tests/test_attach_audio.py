"""Sound attached to datasets that were recorded without it: from a file for each episode, and from a session's recording."""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from dataset_factory import CAMERA, dataset_features, make_dataset
from recording_factory import load
from support.recording import everything, write

from lerobot_playbyear.audio import cut_into_frames, note_episode_start, write_audio
from lerobot_playbyear.audio.attach_audio import AttachAudioConfig, DatasetPlace, attach_audio
from lerobot_playbyear.audio.recorder_clock import CLOCK_PATH, ClockError, read_clock, read_episode_starts
from lerobot_playbyear.datasets import episode_files, episode_waveform
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.datasets.survey import survey
from lerobot_playbyear.repair.repair import repair_dataset

FPS, RATE = 20, 16000
SIZE = RATE // FPS
LENGTHS = (12, 17, 9)  # of the fixture `silent`
KEY = "observation.audio.gripper"
OFFSET = 0.25


def noise(episode: int, n_samples: int, n_channels: int = 1) -> np.ndarray:
    return np.random.default_rng(episode).integers(-3000, 3000, (n_samples, n_channels)).astype(np.int16)


def write_sounds(folder: Path, rate: int = RATE, ending: str = "wav", n_channels: int = 1) -> str:
    for episode, length in enumerate(LENGTHS):
        n_samples = round((OFFSET + length / FPS) * rate)
        write_audio(folder / f"{episode:03d}.{ending}", noise(episode, n_samples, n_channels), rate)
    return f"{folder}/{{episode:03d}}.{ending}"


def attach(root: Path, target: Path, **options) -> Path:
    places = DatasetPlace("test/silent", str(root)), DatasetPlace("test/heard", str(target))
    return attach_audio(AttachAudioConfig(*places, **options))


def attach_files(root: Path, target: Path, files: str, **options) -> Path:
    return attach(root, target, files=files, **{"microphone": "gripper", "offset": OFFSET, **options})


# From a file for each episode


def test_every_frame_gets_what_was_heard_before_it_and_all_else_stays_as_it_was(silent, tmp_path):
    before = everything(silent)
    root = attach_files(silent, tmp_path / "heard", write_sounds(tmp_path / "sound", ending="flac"))

    old, new = load(silent), load(root)
    first, samples = round(OFFSET * RATE) - SIZE, []
    for episode, length in enumerate(LENGTHS):
        waveform, rate = episode_waveform(new, episode, KEY)
        assert rate == RATE
        sound = noise(episode, round((OFFSET + length / FPS) * RATE))[:, 0]
        np.testing.assert_array_equal(waveform, sound[first : first + length * SIZE])
        samples.append(waveform)
    assert set(new.meta.features) - set(old.meta.features) == {KEY}
    for i in (0, 13, 37):
        assert new[i][KEY].shape == (SIZE,)
        for key, value in old[i].items():
            assert np.array_equal(np.asarray(new[i][key]), np.asarray(value)), key
    assert new.meta.stats.keys() == {*old.meta.stats, KEY}
    np.testing.assert_allclose(new.meta.stats[KEY]["std"], np.concatenate(samples).std(), rtol=1e-3)
    np.testing.assert_array_equal(new.meta.stats["action"]["mean"], old.meta.stats["action"]["mean"])
    assert survey(root).is_undamaged
    assert everything(silent) == before
    assert {path.name for path in tmp_path.iterdir()} == {"heard", "sound"}


def test_video_is_copied_and_two_channels_become_two_microphones(tmp_path):
    features = dataset_features(image_size=16, use_videos=True, microphones=())
    make_dataset(tmp_path / "film", LENGTHS, features=features, repo_id="test/silent")
    files = write_sounds(tmp_path / "sound", n_channels=2)
    root = attach_files(tmp_path / "film", tmp_path / "heard", files, microphone="left, right")
    dataset = load(root)
    assert dataset[20][CAMERA].shape == (3, 16, 16)
    expected = noise(1, round((OFFSET + LENGTHS[1] / FPS) * RATE), 2)
    for channel, key in enumerate(("observation.audio.left", "observation.audio.right")):
        waveform, _ = episode_waveform(dataset, 1, key)
        np.testing.assert_array_equal(waveform[:100], expected[round(OFFSET * RATE) - SIZE :, channel][:100])
    assert survey(root).is_undamaged


def test_sound_of_another_rate_is_resampled(silent, tmp_path):
    files = write_sounds(tmp_path / "sound", rate=11025)
    root = attach_files(silent, tmp_path / "heard", files, sample_rate=48000)
    assert load(root).features[KEY]["info"]["sample_rate"] == 48000
    assert load(root)[3][KEY].shape == (2400,)


def test_each_episode_may_have_its_own_offset(silent, tmp_path):
    files = write_sounds(tmp_path / "sound")
    (tmp_path / "offsets.json").write_text("[0, 0.05, -0.1]")
    options = {"offset": 0.1, "offsets": tmp_path / "offsets.json", "pad": True}
    dataset = load(attach_files(silent, tmp_path / "heard", files, **options))
    for episode, offset in enumerate((0.1, 0.15, 0.0)):
        waveform, _ = episode_waveform(dataset, episode, KEY)
        sound = noise(episode, round((OFFSET + LENGTHS[episode] / FPS) * RATE))[:, 0]
        np.testing.assert_array_equal(waveform[2 * SIZE : 3 * SIZE], sound[round(offset * RATE) + SIZE :][:SIZE])


@pytest.mark.parametrize("text", ['{"0": 1, "1": 2, "2": 3}', '"123"', "[0, 1, Infinity]", "[[0], 1, 2]"])
def test_offsets_are_a_list_of_numbers(silent, tmp_path, text):
    (tmp_path / "offsets.json").write_text(text)
    with pytest.raises(InputError, match="is not a list of numbers"):
        attach_files(silent, tmp_path / "heard", write_sounds(tmp_path / "sound"), offsets=tmp_path / "offsets.json")


def test_an_offset_is_finite(silent, tmp_path):
    with pytest.raises(InputError, match="--offset=inf: wanted seconds"):
        attach_files(silent, tmp_path / "heard", write_sounds(tmp_path / "sound"), offset=float("inf"))


def test_the_copy_of_the_folder_one_is_in_lies_beside_it(silent, tmp_path, monkeypatch):
    shutil.copytree(silent, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    files = write_sounds(tmp_path / "sound")
    target = attach_audio(AttachAudioConfig(DatasetPlace("test/silent", "."), files=files, offset=OFFSET))
    assert target == tmp_path / "here_with_sound"


def test_a_second_microphone_can_follow(silent, tmp_path):
    files = write_sounds(tmp_path / "sound")
    one = attach_files(silent, tmp_path / "one", files)
    two = attach_files(one, tmp_path / "two", files, microphone="table")
    assert {KEY, "observation.audio.table"} <= set(load(two).features)


# From one recording of the session


SESSION_LENGTHS = (100, 40, 200)
CLOCK_BEGINS = 1_754_400_000.0  # when the recorder was started
STARTS = (CLOCK_BEGINS + 3.017, CLOCK_BEGINS + 241.5, CLOCK_BEGINS + 270.25)
CLAPS = (CLOCK_BEGINS + 1.0, CLOCK_BEGINS + 285.0)
FAST = 1.001  # the recorder's clock, against the robot's


@pytest.fixture(scope="module")
def long(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("long") / "dataset"
    features = {key: one for key, one in dataset_features().items() if key in ("action", "observation.state")}
    make_dataset(root, SESSION_LENGTHS, features=features, repo_id="test/silent")
    return root


def taps() -> list[tuple[int, int, float]]:
    """A tap in every third frame: episode, frame, and when, anywhere in the middle nine tenths of the frame's block."""
    rng = np.random.default_rng(0)
    return [
        (episode, frame, STARTS[episode] + (frame - rng.uniform(0.05, 0.95)) / FPS)
        for episode, length in enumerate(SESSION_LENGTHS)
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


def share_in_their_blocks(root: Path) -> float:
    """How many of the taps are loudest in the block of their frame, of all frames within two."""
    dataset = load(root)
    found = 0
    for episode, length in enumerate(SESSION_LENGTHS):
        energy = np.abs(episode_waveform(dataset, episode, KEY)[0].reshape(length, SIZE)).max(axis=1).astype(float)
        for _, frame, _ in (tap for tap in taps() if tap[0] == episode):
            nearby = range(max(frame - 1, 0), min(frame + 2, length))
            found += max(nearby, key=lambda i: energy[i]) == frame and energy[frame] > 3000
    return found / len(taps())


def test_taps_land_in_the_blocks_of_their_frames_though_the_recorder_is_fast(long, recording, tmp_path, capsys):
    clock = tmp_path / "starts.csv"
    clock.write_text("episode,seconds\n" + "".join(f"{i},{start!r}\n" for i, start in enumerate(STARTS)))
    root = attach(long, tmp_path / "heard", session=recording, microphone="gripper", clock=clock, marks=marks(*CLAPS))
    assert len(taps()) > 100
    assert share_in_their_blocks(root) >= 0.99
    assert survey(root).is_undamaged
    assert "+1000 parts in a million" in capsys.readouterr().out

    without = attach(
        long, tmp_path / "drifting", session=recording, microphone="gripper", clock=clock, marks=marks(CLAPS[0])
    )
    assert share_in_their_blocks(without) < 0.7, "the test would notice nothing without the drift"


def test_times_in_the_dataset_itself_are_taken(long, recording, tmp_path):
    """Noted while it was recorded; a clap a little off, as a person reads it, costs no tap; an offset is added."""
    shutil.copytree(long, tmp_path / "noted")
    for episode, start in enumerate(STARTS):
        note_episode_start(tmp_path / "noted", episode, start)
    two = f"{1.0 * FAST + 0.5:.3f}={CLAPS[0]:.3f},{285.0 * FAST + 0.5:.3f}={CLAPS[1]:.3f}"
    options = {"session": recording, "microphone": "gripper", "marks": two, "offset": -0.5}
    assert share_in_their_blocks(attach(tmp_path / "noted", tmp_path / "heard", **options)) >= 0.99
    assert read_episode_starts(tmp_path / "heard") == dict(enumerate(STARTS))


def test_without_marks_the_seconds_are_those_of_the_file(long, tmp_path):
    """And not a sample is changed."""
    sound = np.random.default_rng(2).integers(-3000, 3000, 40 * RATE).astype(np.int16)
    session = write_audio(tmp_path / "day.wav", sound, RATE)
    (tmp_path / "starts.json").write_text("[1.5, 10, 12.25]")
    dataset = load(
        attach(long, tmp_path / "heard", session=session, microphone="gripper", clock=tmp_path / "starts.json")
    )
    for episode, (start, length) in enumerate(zip((1.5, 10, 12.25), SESSION_LENGTHS, strict=True)):
        wanted = cut_into_frames(sound, RATE, FPS, length, offset=start)
        np.testing.assert_array_equal(episode_waveform(dataset, episode, KEY)[0], wanted.reshape(-1))


def test_a_recording_without_its_drift_is_the_same_sound_at_the_right_times():
    """A tone of a recorder that is 300 parts in a million slow, below half the sample rate, to 60 dB."""
    for frequency in (440.0, 5000.0):
        drifting = 10_000 * np.sin(2 * np.pi * frequency * np.arange(100_000) / RATE / 0.9997)
        recording = np.round(drifting).astype(np.int16)[:, None]
        steady = cut_into_frames(recording, RATE, FPS, 120, offset=0.1, speed=0.9997).reshape(-1)
        wanted = 10_000 * np.sin(2 * np.pi * frequency * (0.05 + np.arange(len(steady)) / RATE))
        assert np.abs(steady - wanted).max() < 10


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork")
def test_an_episodes_start_is_noted_and_survives_being_killed(tmp_path):
    """The process is killed again and again while it notes: the file is whole at every moment, and loses nothing."""
    note_episode_start(tmp_path, 0, 1754400000.123456)
    for _ in range(3):
        child = os.fork()
        while child == 0:
            for i in range(1, 51):
                note_episode_start(tmp_path, i, i)
        for _ in range(20):
            starts = read_episode_starts(tmp_path)
            assert starts is not None
            assert starts[0] == 1754400000.123456
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        assert (read_episode_starts(tmp_path) or {})[0] == 1754400000.123456
    assert json.loads((tmp_path / CLOCK_PATH).read_text())["episodes"]["0"] == 1754400000.123456
    assert read_clock(tmp_path / CLOCK_PATH) == read_episode_starts(tmp_path)


def test_after_a_repair_the_times_are_those_of_the_same_episodes(tmp_path, monkeypatch):
    """A killed recording: its second data file is lost, and the episode after it moves up."""
    monkeypatch.setattr(episode_files, "SMALL_DATA_BYTES", 0)  # each episode in a file of its own
    write(tmp_path / "lost", range(3))
    for episode, start in enumerate(STARTS):
        note_episode_start(tmp_path / "lost", episode, start)
    files = sorted((tmp_path / "lost").glob("data/*/*.parquet"))
    assert len(files) == 3
    files[1].unlink()
    target = repair_dataset(tmp_path / "lost").target
    assert read_episode_starts(target) == {0: STARTS[0], 1: STARTS[2]}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16-le", "utf-16-be", "utf-16", "cp1252"])
@pytest.mark.parametrize(
    "text",
    [
        "0,1.5\n1,20\n",
        "Episode;Start\r\n0;1.5\r\n\r\n1;20\r\n",
        "episode\tstart\tremark\n0\t1.5\t\n1\t20\tgood\n",
        "Épisode;Début (s)\n0;1,5\n1;20\n",
        "0\t1,5\n1\t20,0\n",
        'épisode,début\n0,"1,5"\n1,"20"\n',
        "sep=;\r\nEpisode;Start, in s\r\n0;1,5\r\n1;20,000\r\n",
        "SEP=,\n0,1.5\n1,20\n",
        "sep=\t\nepisode\tstart; s\n0\t1,5\n1\t20\n",
        "1.500000\t1.500000\tepisode 0\n20.000000\t20.000000\t\n",  # Audacity's labels
    ],
)
def test_a_table_of_times_may_come_from_a_spreadsheet(tmp_path, text, encoding):
    (tmp_path / "times.csv").write_bytes(text.encode(encoding))
    assert read_clock(tmp_path / "times.csv") == {0: 1.5, 1: 20.0}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_times_in_json_may_have_any_order_of_bytes(tmp_path, encoding):
    (tmp_path / "times.json").write_bytes('{"0": 1.5, "1": 20}'.encode(encoding))
    assert read_clock(tmp_path / "times.json") == {0: 1.5, 1: 20.0}


@pytest.mark.parametrize("text", ["0;1.754,5\n", "0;1,754,000\n", "\0\0\0", "0,1\0,5\n", "0,7,53\n", "0.0\t7.5\n"])
def test_marks_between_thousands_and_zeros_are_no_times(tmp_path, text):
    (tmp_path / "times.csv").write_text(text)
    with pytest.raises(ClockError, match="wanted"):
        read_clock(tmp_path / "times.csv")


def test_no_start_is_noted_through_a_link_or_without_a_meaning(tmp_path):
    outside = tmp_path / "precious.json"
    outside.write_text('{"episodes": {}}')
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/meta/playbyear_clock.json").symlink_to(outside)
    with pytest.raises(ClockError, match="is a link"):
        note_episode_start(tmp_path / "dataset", 0, 1.0)
    assert outside.read_text() == '{"episodes": {}}'
    for index, seconds in ((-1, 1.0), (True, 1.0), (0, float("nan")), (0, "soon")):
        with pytest.raises(ClockError, match="wanted"):
            note_episode_start(tmp_path, index, seconds)  # type: ignore[arg-type]
    assert read_episode_starts(tmp_path) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,a\n", "the time of episode 0 is 'a'; wanted seconds"),
        ("0,1\n0,2\n", "names episode 0 twice"),
        ("0 1\n", "a line is '0 1'; wanted episode and seconds, such as 0,12.5"),
        ("1,2\n", "has no time for episodes 0, 2; the dataset has 3 episodes"),
        ("0,1\n1,2\n2,500\n", r"episode 2, which began at 500.000 s of the clock: .*at its end more"),
    ],
)
def test_a_table_that_does_not_fit_is_one_clear_error(silent, tmp_path, text, message):
    (tmp_path / "starts.csv").write_text(text)
    session = write_audio(tmp_path / "day.wav", np.zeros(30 * RATE, np.int16), RATE)
    with pytest.raises(InputError, match=message):
        attach(silent, tmp_path / "heard", session=session, clock=tmp_path / "starts.csv")
    assert not (tmp_path / "heard").exists()
