"""What `DurableWriter` leaves on the disk, whatever happens to it."""

import contextlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.io_utils import load_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from recording_factory import (
    CAMERA,
    FEATURES,
    FPS,
    MICROPHONE,
    REPO_ID,
    RICH_FEATURES,
    SECOND_MICROPHONE,
    differences,
    episode_frames,
    load,
)
from support.commands import run_without
from support.failing import PowerCut, fail_once
from support.recording import ENCODER, assert_recorded, everything, write, write_episode, writer

from lerobot_playbyear.datasets import audio_feature, episode_files, journal
from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter
from lerobot_playbyear.datasets.files import FolderLockedError
from lerobot_playbyear.datasets.journal import (
    JOURNAL,
    LOCK,
    STAGING,
    JournalError,
    finish_journal,
    lock_dataset,
    publish,
)

# What is on the disk


def test_every_value_comes_back_and_nothing_else_stays(tmp_path):
    root = tmp_path / "dataset"
    with writer(root, RICH_FEATURES) as target:
        for number in range(4):
            write_episode(target, number)
        target.add_frame(episode_frames(4, RICH_FEATURES)[0])
    assert_recorded(root, range(4), RICH_FEATURES)
    assert {path.name for path in root.iterdir()} == {"data", "meta", "images", "videos"}
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]


def test_short_episodes_share_files_and_large_files_are_not_written_again(tmp_path, monkeypatch):
    root = tmp_path / "dataset"
    write(root, range(2))
    write(root, range(2, 4))
    assert len(list(root.glob("data/*/*"))) == len(list(root.glob("meta/episodes/*/*"))) == 1
    assert pq.ParquetFile(next(root.glob("data/*/*"))).num_row_groups == 4  # LeRobot's: one per episode
    monkeypatch.setattr(episode_files, "SMALL_DATA_BYTES", 5000)
    monkeypatch.setattr(episode_files, "SMALL_TABLE_BYTES", 5000)
    write(root, range(4, 6))
    assert [path.name for path in sorted(root.glob("data/*/*"))] == [f"file-00{i}.parquet" for i in range(3)]
    assert_recorded(root, range(6))


def test_a_damaged_file_is_not_continued(tmp_path, caplog):
    """Its episodes can be repaired later; the new one must not be lost with them."""
    root = tmp_path / "dataset"
    write(root, [0])
    path = next(root.glob("data/*/*"))
    with writer(root) as target:
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 16
        path.write_bytes(data)
        write_episode(target, 1)
    assert len(list(root.glob("data/*/*"))) == 2
    assert "is not continued" in caplog.text


@pytest.mark.parametrize(("name", "limit"), [("noise", 2.2), ("silence", 0.2)])
def test_sound_takes_little_room(tmp_path, name, limit):
    """Bytes a sample at 48 kHz, of noise at full scale and of silence."""
    rate, n_frames = 48000, 100
    features = {MICROPHONE: audio_feature(rate, FPS), "action": FEATURES["action"]}
    rng = np.random.default_rng(0)
    with DurableWriter(REPO_ID, tmp_path, FPS, features, resume=True) as target:
        for _ in range(n_frames):
            sound = rng.integers(-32768, 32768, rate // FPS) if name == "noise" else np.zeros(rate // FPS)
            target.add_frame({MICROPHONE: sound.astype(np.int16), "action": np.zeros(4, np.float32), "task": "listen"})
        target.save_episode()
    assert sum(path.stat().st_size for path in tmp_path.glob("data/*/*")) / (n_frames * rate / FPS) < limit
    assert sum(path.stat().st_size for path in tmp_path.glob("meta/episodes/*/*")) < 20_000
    assert (tmp_path / "meta/stats.json").stat().st_size < 250_000  # once: LeRobot wants it per sample index


# Other tools


def rows_of(root: Path) -> dict[str, list]:
    """All that a dataset's tables hold: frames, episodes with their statistics, tasks."""
    frames = pa.concat_tables([pq.read_table(path) for path in sorted(root.glob("data/*/*"))])
    episodes = pa.concat_tables([pq.read_table(path) for path in sorted(root.glob("meta/episodes/*/*"))])
    places = [name for name in episodes.column_names if name.endswith(("chunk_index", "file_index"))]
    tasks = pq.read_table(root / "meta/tasks.parquet")
    return {**frames.to_pydict(), **episodes.drop_columns(places).to_pydict(), **tasks.to_pydict()}


def test_rows_and_statistics_are_those_that_lerobot_writes(tmp_path):
    """Of the same frames; but for a microphone's statistics, which are of all its samples."""
    features = {key: feature for key, feature in RICH_FEATURES.items() if key not in (MICROPHONE, SECOND_MICROPHONE)}
    features["matrix"] = {"dtype": "float32", "shape": (2, 3), "names": None}
    features["note"] = {"dtype": "string", "shape": (1,), "names": None}
    features["depth"] = {"dtype": "image", "shape": (16, 16, 1), "names": None, "info": {"is_depth_map": True}}
    lerobot = LeRobotDataset.create(
        REPO_ID, FPS, deepcopy(features), root=tmp_path / "lerobot", video_backend="pyav", rgb_encoder=ENCODER
    )
    with writer(tmp_path / "ours", features) as target:
        for number in range(2):
            for frame in episode_frames(number, RICH_FEATURES):
                rng = np.random.default_rng(number)
                own = {key: value for key, value in frame.items() if key in features or key == "task"}
                own |= {"matrix": rng.random((2, 3)).astype(np.float32), "note": f"note {number}"}
                own["depth"] = rng.integers(0, 5000, (16, 16, 1)).astype(np.uint16)
                target.add_frame(own)
                lerobot.add_frame(dict(own))
            target.save_episode()
            lerobot.save_episode(parallel_encoding=False)
    lerobot.finalize()
    ours, theirs = rows_of(tmp_path / "ours"), rows_of(tmp_path / "lerobot")
    assert list(ours) == list(theirs)
    films = [name for name in ours if name.endswith("_timestamp")]  # LeRobot puts films into one file
    assert {name: ours[name] for name in ours if name not in films} == {
        name: theirs[name] for name in theirs if name not in films
    }
    info, their_info = (json.loads((tmp_path / name / "meta/info.json").read_text()) for name in ("ours", "lerobot"))
    assert info == their_info
    stats, their_stats = (load_stats(tmp_path / name) for name in ("ours", "lerobot"))
    assert stats.keys() == their_stats.keys()
    for key, own in their_stats.items():
        for name, value in own.items():
            np.testing.assert_allclose(stats[key][name], value, rtol=1e-12, err_msg=f"{key} {name}")


def test_lerobot_goes_on_with_our_dataset_and_we_with_lerobots(tmp_path):
    root = tmp_path / "dataset"
    write(root, range(2), RICH_FEATURES)
    dataset = LeRobotDataset.resume(REPO_ID, root=root, video_backend="pyav", rgb_encoder=ENCODER)
    for frame in episode_frames(2, RICH_FEATURES):
        dataset.add_frame(frame)
    dataset.save_episode()
    dataset.finalize()
    write(root, [3], RICH_FEATURES)
    assert_recorded(root, range(4), RICH_FEATURES)


# Crashes


@pytest.mark.parametrize("moves_before", [0, 1, 3, 5])
def test_a_crash_while_an_episode_is_moved_into_place_loses_nothing(tmp_path, monkeypatch, caplog, moves_before):
    """At every move: the dataset loads before and after recovery, and recording goes on."""
    root = tmp_path / "dataset"
    write(root, [0])
    target = writer(root)
    fail_once(monkeypatch, journal.os, "replace", moves_before)
    with pytest.raises(PowerCut):
        write_episode(target, 1)
    monkeypatch.undo()
    target._lock.close()

    crashed = load(root)
    assert not differences(crashed, {n: n for n in range(crashed.num_episodes)}, FEATURES)
    with writer(root) as target:
        survived = target.num_episodes
        assert survived == (1 if moves_before == 0 else 2)  # the journal is the first move, and the point of no return
        assert ("an episode that had not been saved was removed" in caplog.text) is (survived == 1)
        write_episode(target, 2)
    assert_recorded(root, [0, 1, 2] if survived == 2 else [0, 2])


def test_files_are_on_the_disk_before_anything_refers_to_them(tmp_path, monkeypatch):
    """A power cut keeps what was synchronised: content and folder entry of every file, in this order."""
    root = tmp_path / "dataset"
    write(root, [0], RICH_FEATURES)
    events: list[tuple[str, Path]] = []
    real_replace, real_fsync = os.replace, os.fsync

    def fsync(descriptor: int) -> None:
        events.append(("sync", Path(os.readlink(f"/proc/self/fd/{descriptor}"))))
        real_fsync(descriptor)

    def replace(source, target):
        events.append(("move", Path(source)))
        real_replace(source, target)
        events.append(("moved", Path(target)))

    monkeypatch.setattr(journal.os, "fsync", fsync)
    monkeypatch.setattr(journal.os, "replace", replace)
    write(root, [1], RICH_FEATURES)
    monkeypatch.undo()

    moves = [path for what, path in events if what == "move"]
    assert moves[0].name == ".journal.json.partial"
    assert moves[-1] == root / "images/.staging/meta/info.json"
    journal_stands = events.index(("sync", root / "images"), events.index(("move", moves[0])))
    for path in moves:
        content = events.index(("sync", path))
        assert content < events.index(("move", path))
        if path != moves[0]:
            assert max(content, events.index(("sync", path.parent))) < journal_stands < events.index(("move", path))
    for at, (what, path) in enumerate(events):
        if what == "moved":
            assert ("sync", path.parent) in events[at:]


def test_folders_above_a_new_dataset_are_on_the_disk(tmp_path, monkeypatch):
    synchronised, real = set(), os.fsync

    def fsync(descriptor: int) -> None:
        synchronised.add(Path(os.readlink(f"/proc/self/fd/{descriptor}")))
        real(descriptor)

    monkeypatch.setattr(journal.os, "fsync", fsync)
    write(tmp_path / "user/dataset", [0])
    assert {tmp_path, tmp_path / "user", tmp_path / "user/dataset"} <= synchronised


def record_and_kill(root: Path, episodes: int, share: float) -> int:
    """Has a child record, and kills it.

    Args:
        root: The dataset's folder.
        episodes: How many it may save first; -1: it is killed while it opens the dataset.
        share: When it is killed, as a share of the time that the last episode, or the opening, took.

    Returns:
        How many episodes it reported to be saved.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            target = writer(root, RICH_FEATURES)
            while True:
                os.write(writing, b"%d\n" % target.num_episodes)
                write_episode(target, target.num_episodes)
        except BaseException as error:
            os.write(writing, f"{error!r}\n".encode())
        os._exit(1)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        lines: list[str] = []
        last, took = time.monotonic(), 0.5
        while len(lines) < episodes + 1:
            lines.append(pipe.readline())
            assert lines[-1], "the child ended"
            took, last = time.monotonic() - last, time.monotonic()
        time.sleep(share * took)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        counts = [int(line) for line in [*lines, *pipe.read().split("\n")[:-1]]]  # an error is no number
    return counts[-1] if counts else 0


READ_BY_LEROBOT = """
import random, sys
sys.path.insert(0, {tests!r})
from recording_factory import RICH_FEATURES, differences, load
for root, n_before, n_episodes in {copies!r}:
    dataset = load(root)
    some = random.Random(n_before).sample(range(n_before), min(n_before, 5))
    wrong = differences(dataset, {{n: n for n in [*some, *range(n_before, n_episodes)]}}, RICH_FEATURES)
    # the rows of an episode that was not yet reported may be there
    print(root, dataset.num_episodes - n_episodes, min(len(dataset.hf_dataset) - dataset.num_frames, 0), wrong[:5])
"""


@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork")
@pytest.mark.parametrize("n_kills", [2, pytest.param(100, marks=pytest.mark.slow)])
def test_every_reported_episode_survives_sigkill(tmp_path, monkeypatch, n_kills):
    """What each kill leaves is read by a process that has LeRobot alone."""
    root, rng = tmp_path / "dataset", np.random.default_rng(0)
    saved, copies = 0, []
    for kill in range(n_kills):
        episodes = 1 if kill == 0 else int(rng.integers(-1, 3))
        reported = record_and_kill(root, episodes, share=float(rng.random()))
        assert reported >= saved + episodes if episodes >= 0 else reported in (0, saved, saved + 1)
        before, reported = saved, max(saved, reported)
        saved = json.loads((root / "meta/info.json").read_text())["total_episodes"]
        assert saved in (reported, reported + 1)  # one may have been complete, and not yet reported
        copies.append((shutil.copytree(root, tmp_path / f"{kill}"), before, saved))
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    read = READ_BY_LEROBOT.format(tests=str(Path(__file__).parent), copies=[(str(copy), *n) for copy, *n in copies])
    answers = run_without({"lerobot_playbyear", "lerobot_policy_playbyear", "gym_playbyear"}, read)
    assert answers.split("\n") == [*(f"{copy} 0 0 []" for copy, *_ in copies), ""]
    writer(root, RICH_FEATURES).close()
    assert_recorded(root, range(load(root).num_episodes), RICH_FEATURES)


# A journal is taken for a stranger's: what is moved stays inside the dataset, or nothing is moved at all


@pytest.fixture
def root(tmp_path) -> Path:
    """A dataset of one episode, two folders below one that nothing may reach."""
    root = tmp_path / "outside/datasets/dataset"
    write(root, [0])
    return root


def plant(root: Path, names: str = "", victim: str = "data/new.parquet") -> None:
    """A journal as a stranger may write one, with a file that it could move."""
    (root / STAGING / victim).parent.mkdir(parents=True, exist_ok=True)
    (root / STAGING / victim).write_bytes(b"a stranger's")
    (root / JOURNAL).write_text(names)


@pytest.mark.parametrize("names", ["", '["../x", "a/../../../../x"]', "[" * 100_000])
def test_nothing_is_moved_out_of_the_dataset_whatever_a_journal_says(root, tmp_path, names):
    plant(root, names)
    (root / STAGING / "../../x").write_bytes(b"not staged")
    (root / STAGING / "x").write_bytes(b"no file of a dataset")
    before = everything(tmp_path)
    finish_journal(root)
    after = everything(tmp_path)
    where = root.relative_to(tmp_path)
    assert after.pop(str(where / "data/new.parquet"))[0] == b"a stranger's"
    assert before.keys() - after.keys() == {
        str(where / name) for name in (STAGING / "data/new.parquet", STAGING / "x", JOURNAL)
    }
    assert all(before[name] == content for name, content in after.items())


def test_no_link_is_followed(root, tmp_path):
    """A link in place of the journal, the lock, the scratch folder, or a folder of the dataset or of the staging."""
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / ".staging").mkdir(parents=True)
    for name in ("file-000.mp4", JOURNAL.name, ".staging/thesis.tex"):
        (elsewhere / name).write_bytes(b"the user's own")
    places = {
        root / JOURNAL: root / "meta/info.json",
        root / "videos": elsewhere,
        root / STAGING / "videos": elsewhere,
        root / STAGING / "videos/file-000.mp4": elsewhere / "file-000.mp4",
        root / STAGING: elsewhere,
        root / "images": elsewhere,
    }
    for place, target in places.items():
        shutil.rmtree(root / "images")
        plant(root, victim="videos/file-000.mp4" if place == root / "videos" else "data/new.parquet")
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        place.symlink_to(target)
        before = everything(tmp_path)
        for refused in (finish_journal, publish, writer):
            if place == root / JOURNAL and refused is publish:
                continue  # it writes its own in its place
            with pytest.raises(JournalError, match=r"is a link|not an ordinary file"):
                refused(root)
            assert everything(tmp_path) == before, place
        assert not (elsewhere / ".lock").exists()
        place.unlink()
        (root / "images").mkdir(exist_ok=True)
    (root / LOCK).unlink(missing_ok=True)
    (root / LOCK).symlink_to(tmp_path / "new")
    with pytest.raises(OSError, match="symbolic link"):
        lock_dataset(root)
    assert not (tmp_path / "new").exists()


def test_a_dataset_that_is_reached_by_a_link_is_written(root, tmp_path):
    (tmp_path / "link").symlink_to(root)
    write(tmp_path / "link", [1])
    assert (tmp_path / "link").is_symlink()
    assert load(root).num_episodes == 2


# Who may write, and what


def hold(root: Path, answers) -> None:
    """Takes the lock five times, and tells how often another one had it as well."""
    taken = doubled = 0
    while taken < 5:
        with contextlib.suppress(FolderLockedError):
            lock = lock_dataset(root)
            try:
                (root / "held").mkdir()
            except FileExistsError:
                doubled += 1
            else:
                taken += 1
                time.sleep(0.0005)
                (root / "held").rmdir()
            lock.close()
        time.sleep(random.uniform(0.001, 0.004))  # or all of them only ever stand in each other's way
    answers.put(doubled)


def test_two_processes_never_hold_the_lock_at_once(tmp_path):
    processes = multiprocessing.get_context("fork")
    answers = processes.Queue()
    workers = [processes.Process(target=hold, args=(tmp_path, answers)) for _ in range(4)]
    for worker in workers:
        worker.start()
    assert [answers.get(timeout=90) for _ in workers] == [0] * 4
    for worker in workers:
        worker.join()


@pytest.mark.filterwarnings("ignore:flock not supported")
@pytest.mark.parametrize("has_locks", [True, False])
def test_a_second_writer_waits_until_the_first_has_closed(tmp_path, monkeypatch, has_locks):
    """Also on a disk without locks of the system, where the lock's file alone tells."""
    fcntl = pytest.importorskip("fcntl")

    def fail(*_):
        raise OSError(38, "Function not implemented")

    if not has_locks:
        monkeypatch.setattr(fcntl, "flock", fail)
    first = writer(tmp_path)
    with pytest.raises(FolderLockedError, match="Another process is writing"):
        writer(tmp_path)
    first.close()
    with writer(tmp_path):
        staged = tmp_path / STAGING / "of_the_second"
        staged.mkdir(parents=True)
        first.close()  # once more: the dataset is another's now
        assert staged.is_dir()


def arm(*joints: str) -> dict[str, Any]:
    return {**FEATURES, "action": {**FEATURES["action"], "names": [f"{joint}.pos" for joint in joints]}}


def test_another_robot_or_other_joints_are_not_appended(tmp_path):
    joints = ("pan", "lift", "elbow", "grip")
    write(tmp_path / "data", [0], arm(*joints), robot_type="so101_follower")
    swapped = "the numbers of action are pan.pos, lift.pos, elbow.pos, grip.pos there and lift.pos, pan.pos, elbow.pos"
    with pytest.raises(ValueError, match=swapped):
        writer(tmp_path / "data", arm("lift", "pan", "elbow", "grip"), robot_type="so101_follower")
    with pytest.raises(ValueError, match="the robot is so101_follower there and koch_follower here"):
        writer(tmp_path / "data", arm(*joints), robot_type="koch_follower")
    write(tmp_path / "data", [1], arm(*joints), robot_type="so101_follower")
    write(tmp_path / "data", [2])  # says neither
    assert_recorded(tmp_path / "data", range(3))


@pytest.mark.parametrize("fps", [0, 29.97, True, "20"])
def test_a_frame_rate_that_is_none_is_refused(tmp_path, fps):
    with pytest.raises(ValueError, match=rf"fps={fps!r}"):
        DurableWriter(REPO_ID, tmp_path / "dataset", fps, FEATURES)
    assert not (tmp_path / "dataset").exists()


def floats(value: float) -> np.ndarray:
    sound = np.zeros(80, np.float32)
    sound[17] = value
    return sound


REFUSED = [
    (MICROPHONE, floats(np.nan), f"'{MICROPHONE}': sample 17 is nan"),
    (MICROPHONE, floats(1.25), r"sample 17 is 1\.25; .*\[-1, 1\]"),
    (MICROPHONE, floats(0).astype(np.float64), "float64"),
    (MICROPHONE, np.zeros(79, np.float32), r"\(79,\)"),
    (MICROPHONE, [0.0] * 80, "list"),
    (CAMERA, np.full((16, 16, 3), 2.0, np.float32), rf"'{CAMERA}'.*\[0\.0, 1\.0\]"),
    (CAMERA, np.zeros((16, 8, 3), np.uint8), r"\(16, 8, 3\)"),
    ("task", None, "'task'"),
    ("task", b"Knock.", "'task'"),
]


def test_a_bad_frame_is_refused_and_the_episode_goes_on(tmp_path):
    features = {**FEATURES, MICROPHONE: {**FEATURES[MICROPHONE], "dtype": "float32"}}
    good = [
        {**frame, MICROPHONE: (frame[MICROPHONE] / 32768).astype(np.float32)} for frame in episode_frames(0, FEATURES)
    ]
    good += [{**good[0], MICROPHONE: floats(value)} for value in (1.0, -1.0)]  # full scale is not too loud
    with writer(tmp_path, features) as target:
        with pytest.raises(DatasetWriteError, match="Episode 0 has no frames"):
            target.save_episode()
        for frame in good:
            for key, value, message in REFUSED:
                with pytest.raises(ValueError, match=message):
                    target.add_frame({**frame, key: value})
            again = {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in frame.items()}
            target.add_frame(again)
            for value in again.values():  # a camera, or a sound card, may use its memory again
                if isinstance(value, np.ndarray):
                    value.fill(0)
        target.save_episode()
    dataset = load(tmp_path)
    assert dataset.num_frames == len(good)
    for index, frame in enumerate(good):
        for key in (MICROPHONE, "action"):
            np.testing.assert_array_equal(dataset[index][key].numpy(), frame[key])
        pixels = (dataset[index][CAMERA].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
        np.testing.assert_array_equal(pixels, frame[CAMERA])
