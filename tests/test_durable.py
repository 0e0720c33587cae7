"""What `DurableWriter` leaves on the disk, whatever happens to it."""

import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.io_utils import load_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from recording_factory import (
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

from lerobot_playbyear.datasets import audio_feature, episode_files, journal
from lerobot_playbyear.datasets.durable import DatasetWriteError, DurableWriter
from lerobot_playbyear.datasets.survey import survey

ENCODER = RGBEncoderConfig(vcodec="h264", preset="ultrafast")


def writer(root: Path, features: dict[str, Any] = FEATURES, **options) -> DurableWriter:
    return DurableWriter(REPO_ID, root, FPS, features, **{"rgb_encoder": ENCODER, "resume": True, **options})


def write_episode(target: DurableWriter, number: int) -> int:
    for frame in episode_frames(number, target.features):
        target.add_frame(frame)
    return target.save_episode()


def write(root: Path, numbers: range | list[int], features: dict[str, Any] = FEATURES, **options) -> None:
    with writer(root, features, **options) as target:
        for number in numbers:
            write_episode(target, number)


def is_as_recorded(root: Path, numbers: range | list[int], features: dict[str, Any] = FEATURES) -> bool:
    dataset = load(root)
    assert dataset.num_episodes == len(numbers)
    assert not differences(dataset, dict(enumerate(numbers)), features)
    return True


# What is on the disk


def test_every_value_comes_back(tmp_path):
    write(tmp_path / "dataset", range(4), RICH_FEATURES)
    assert is_as_recorded(tmp_path / "dataset", range(4), RICH_FEATURES)
    assert survey(tmp_path / "dataset").is_sound


def test_nothing_but_the_dataset_stays_on_disk(tmp_path):
    root = tmp_path / "dataset"
    with writer(root) as target:
        write_episode(target, 0)
        target.add_frame(episode_frames(1, FEATURES)[0])
    assert {path.name for path in root.iterdir()} == {"data", "meta", "images"}
    assert [path.name for path in (root / "images").iterdir()] == [".lock"]
    assert is_as_recorded(root, [0])


def test_short_episodes_share_files(tmp_path):
    root = tmp_path / "dataset"
    write(root, range(3))
    write(root, range(3, 6))
    assert len(list(root.glob("data/*/*"))) == len(list(root.glob("meta/episodes/*/*"))) == 1
    assert pq.ParquetFile(next(root.glob("data/*/*"))).num_row_groups == 6  # LeRobot's: one per episode
    assert is_as_recorded(root, range(6))


def test_large_files_are_not_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr(episode_files, "SMALL_DATA_BYTES", 5000)
    monkeypatch.setattr(episode_files, "SMALL_TABLE_BYTES", 5000)
    root = tmp_path / "dataset"
    write(root, range(4))
    assert [path.name for path in sorted(root.glob("data/*/*"))] == [f"file-00{i}.parquet" for i in range(4)]
    assert is_as_recorded(root, range(4))


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


SECONDS, RATE = 5, 48000


@pytest.fixture(scope="module")
def sizes(tmp_path_factory) -> dict[str, tuple[Path, int]]:
    """Two episodes with one microphone at 48 kHz, of noise at full scale and of silence."""
    folder = tmp_path_factory.mktemp("sizes")
    features = {MICROPHONE: audio_feature(RATE, FPS), "action": FEATURES["action"]}
    rng = np.random.default_rng(0)
    found = {}
    for name in ("noise", "silence"):
        with DurableWriter(REPO_ID, folder / name, FPS, features) as target:
            for _ in range(2):
                for _ in range(SECONDS * FPS):
                    sound = rng.integers(-32768, 32768, RATE // FPS) if name == "noise" else np.zeros(RATE // FPS)
                    frame = {MICROPHONE: sound.astype(np.int16), "action": np.zeros(4, np.float32), "task": "listen"}
                    target.add_frame(frame)
                target.save_episode()
        found[name] = (folder / name, 2 * SECONDS * RATE)
    return found


@pytest.mark.parametrize(("name", "limit"), [("noise", 2.2), ("silence", 0.2)])
def test_sound_takes_little_room(sizes, name, limit):
    root, n_samples = sizes[name]
    assert sum(path.stat().st_size for path in root.glob("data/*/*")) / n_samples < limit


def test_an_episode_adds_little_to_the_metadata(sizes):
    root, _ = sizes["noise"]
    grown = sum(path.stat().st_size for path in root.glob("meta/episodes/*/*"))
    assert grown < 2 * 20_000
    assert (root / "meta/stats.json").stat().st_size < 250_000  # once per dataset: LeRobot wants it per sample index


def test_a_microphones_statistics_are_those_of_all_its_samples(tmp_path):
    root = tmp_path / "dataset"
    write(root, range(3))
    stats = load(root).meta.stats[MICROPHONE]
    samples = np.concatenate([frame[MICROPHONE] for number in range(3) for frame in episode_frames(number, FEATURES)])
    n_frames = len(samples) // 80
    expected = {"min": samples.min(), "max": samples.max(), "mean": samples.mean(), "std": samples.std()}
    assert int(stats["count"][0]) == n_frames
    for name, value in expected.items():
        assert stats[name].shape == (80,)
        np.testing.assert_allclose(stats[name], value, rtol=1e-3)


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
    write(root, range(2))
    dataset = LeRobotDataset.resume(REPO_ID, root=root, video_backend="pyav")
    for number in (2, 3):
        for frame in episode_frames(number, FEATURES):
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    write(root, range(4, 6))
    assert is_as_recorded(root, range(6))
    assert survey(root).is_sound
    assert int(load(root).meta.stats[MICROPHONE]["count"][0]) == load(root).num_frames


def test_lerobot_merges_and_deletes(tmp_path):
    write(tmp_path / "one", range(3), RICH_FEATURES)
    write(tmp_path / "two", range(3, 5), RICH_FEATURES)
    aggregate_datasets(
        ["a/one", "a/two"], REPO_ID, roots=[tmp_path / "one", tmp_path / "two"], aggr_root=tmp_path / "merged"
    )
    assert is_as_recorded(tmp_path / "merged", range(5), RICH_FEATURES)
    assert survey(tmp_path / "merged").is_sound
    delete_episodes(load(tmp_path / "merged"), [1, 3], output_dir=tmp_path / "left", repo_id=REPO_ID)
    assert survey(tmp_path / "left").is_sound
    write(tmp_path / "left", [7], RICH_FEATURES)
    assert is_as_recorded(tmp_path / "left", [0, 2, 4, 7], RICH_FEATURES)


# Crashes


class PowerCut(BaseException):
    """Stops the process at a chosen moment, so that no clean-up of ours runs."""


@pytest.mark.parametrize("moves_before", [0, 1, 3, 5])
def test_a_crash_while_an_episode_is_moved_into_place_loses_nothing(tmp_path, monkeypatch, moves_before):
    """At every move: the dataset loads before and after recovery, and recording goes on."""
    root = tmp_path / "dataset"
    write(root, [0])
    target = writer(root)
    moves = iter(range(100))
    real_replace = os.replace

    def replace(source, target):
        if next(moves) == moves_before:
            raise PowerCut
        real_replace(source, target)

    monkeypatch.setattr(journal.os, "replace", replace)
    with pytest.raises(PowerCut):
        write_episode(target, 1)
    monkeypatch.undo()
    target._lock.release()

    crashed = load(root)
    assert not differences(crashed, {n: n for n in range(crashed.num_episodes)}, FEATURES)
    with writer(root) as target:
        survived = target.num_episodes
        assert survived == (1 if moves_before == 0 else 2)  # the journal is the first move, and the point of no return
        write_episode(target, 2)
    assert is_as_recorded(root, [0, 1, 2] if survived == 2 else [0, 2])
    stats = load(root).meta.stats["action"]
    assert int(stats["count"][0]) == load(root).num_frames


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
    with writer(root, RICH_FEATURES) as target:
        write_episode(target, 1)
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


KILLER = Path(__file__).parent / "recording_forks.py"


class Forks:
    """A process that has imported what it needs, and forks a child for each order: a fresh process without the wait."""

    def __init__(self, role: str, cache: Path) -> None:
        environment = {**os.environ, "HF_DATASETS_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, str(KILLER), role],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )

    def order(self, **what: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(what), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def forks(tmp_path_factory) -> Iterator[tuple[Forks, Forks]]:
    """One that records and is killed, and one that knows only LeRobot and reads."""
    both = tuple(Forks(role, tmp_path_factory.mktemp("cache")) for role in ("record", "read"))
    yield both
    for one in both:
        one.close()


def kill_at_random(forks: tuple[Forks, Forks], root: Path, n_kills: int) -> None:
    recorder, reader = forks
    rng = np.random.default_rng(0)
    saved = 0
    for kill in range(n_kills):
        episodes = 1 if kill == 0 else int(rng.integers(-1, 3))
        after = recorder.order(root=str(root), episodes=episodes, share=float(rng.random()))
        assert after["error"] is None
        assert after["saved"] >= saved + episodes if episodes >= 0 else after["saved"] in (0, saved, saved + 1)
        saved, saved_before = max(saved, after["saved"]), saved
        found = reader.order(root=str(root), begin=saved_before)
        assert found["error"] is None
        assert not found["wrong"]
        assert found["rows"] >= found["frames"]  # those of an episode that was not yet reported may be there
        assert found["episodes"] in (saved, saved + 1)  # one may have been complete, and not yet reported
        saved = found["episodes"]
    with writer(root, RICH_FEATURES):
        pass
    assert survey(root).is_sound
    assert is_as_recorded(root, range(load(root).num_episodes), RICH_FEATURES)


def test_every_reported_episode_survives_sigkill(forks, tmp_path):
    kill_at_random(forks, tmp_path / "dataset", 3)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_every_reported_episode_survives_a_hundred_sigkills(forks, tmp_path):
    kill_at_random(forks, tmp_path / "dataset", 100)


# Disks


@pytest.mark.parametrize("limit", [1000, 5000, 30_000])
def test_a_full_disk_leaves_the_dataset_as_it_was(tmp_path, limit):
    root = tmp_path / "dataset"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with writer(root) as target:
        write_episode(target, 0)
        for number in range(1, 12):
            for frame in episode_frames(number, FEATURES):
                target.add_frame(frame)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
            with pytest.raises(DatasetWriteError, match=r"Episode 1 could not be written.*1 episodes before it"):
                target.save_episode()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert is_as_recorded(root, [0])
        assert target.save_episode() == 1  # there is room again
    dataset = load(root)
    assert dataset.num_episodes == 2
    assert dataset.num_frames == sum(len(episode_frames(number, FEATURES)) for number in range(12))


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("mounting a small disk takes root")
    if subprocess.run([mount, "-t", "tmpfs", "-o", "size=600k", "tmpfs", folder], check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_disk_that_fills_up(small_disk):
    """Until it is full every episode is safe; then there is one error, and after it the dataset is whole."""
    root = small_disk / "dataset"
    with pytest.raises(DatasetWriteError, match="the disk is full"):
        write(root, range(100))
    saved = load(root).num_episodes
    assert saved >= 2
    assert is_as_recorded(root, range(saved))
    with contextlib.suppress(DatasetWriteError):  # closing freed what the episode that failed had taken
        write(root, [saved])
    assert is_as_recorded(root, range(load(root).num_episodes))


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A folder that this process can read and not write to, even as root."""
    for path in [*folder.rglob("*"), *list(folder.parents)[:3]]:  # pytest's own are closed to others
        path.chmod(path.stat().st_mode | 0o555)
    folder.chmod(0o555)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)
        folder.chmod(0o755)


def test_a_read_only_folder_gives_one_clear_error(tmp_path):
    root = tmp_path / "dataset"
    write(root, [0])
    with read_only(root), pytest.raises(DatasetWriteError, match=f"Cannot write to {root}: Permission denied"):
        writer(root)
    assert is_as_recorded(root, [0])


# Who may write


def test_a_dataset_of_another_kind_is_refused(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "demo.hdf5").write_bytes(b"\x89HDF")
    with pytest.raises(FileExistsError, match="is not empty and holds no dataset"):
        writer(tmp_path)


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
    assert is_as_recorded(tmp_path / "data", range(3))
