"""The store on disk: what memory would hold, made once, never half, and never another dataset's."""

import errno
import json
import logging
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, dataset_features, make_dataset, random_frame
from disk_forks import IMAGE_SIZE

from lerobot_playbyear.datasets import EpisodeStore, disk_columns, reading
from lerobot_playbyear.datasets.disk_columns import CacheError
from lerobot_playbyear.datasets.identity import dataset_identity
from lerobot_playbyear.datasets.opening import open_dataset
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.image_augmentation import Augmentation, resize

LENGTHS = (12, 17, 9)
SIZE = 32
DELTAS = {CAMERA: range(-4, 1), MICROPHONE: range(-20, 1), "action": range(-3, 1)}


@pytest.fixture(scope="module", params=[False, True], ids=["image", "video"])
def root(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, LENGTHS, image_size=SIZE, use_videos=request.param)
    return root


def load(root, cache, **options):
    return EpisodeStore.load(
        "tests/noise", root, device="cpu", video_backend="pyav", place="disk", cache=cache, **options
    )


def in_memory(root, **options):
    return EpisodeStore.load("tests/noise", root, device="cpu", video_backend="pyav", **options)


def assert_same(store, other):
    assert store.keys == other.keys
    for key in store.keys:
        assert torch.equal(store.column(key), other.column(key)), key
    batch, expected = store.windows([0, 14, 37], DELTAS), other.windows([0, 14, 37], DELTAS)
    assert all(torch.equal(batch[key], expected[key]) for key in DELTAS)


def folders(cache):
    return sorted(path for path in cache.iterdir() if path.is_dir())


@pytest.fixture
def no_decoding(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("something was decoded")

    def forbid():
        for name in ("video_pieces", "image_pieces", "value_pieces"):
            monkeypatch.setattr(reading, name, refuse)

    return forbid


@pytest.mark.parametrize("image_size", [None, 24])
def test_the_disk_holds_what_memory_would_and_a_second_run_decodes_nothing(root, tmp_path, no_decoding, image_size):
    expected = in_memory(root, image_size=image_size)
    assert_same(load(root, tmp_path, image_size=image_size), expected)
    no_decoding()
    assert_same(load(root, tmp_path, image_size=image_size), expected)
    assert load(root, tmp_path, image_size=image_size).column(CAMERA).shape[-1] == (image_size or SIZE)


def test_each_size_and_each_choice_of_episodes_has_a_folder(root, tmp_path):
    load(root, tmp_path)
    load(root, tmp_path, image_size=24)
    some = load(root, tmp_path, episodes=[0, 2])
    assert len(folders(tmp_path)) == 3
    assert_same_columns(some, in_memory(root, episodes=[0, 2]))


def assert_same_columns(store, other):
    assert all(torch.equal(store.column(key), other.column(key)) for key in other.keys)


def test_shrunk_pictures_are_those_that_the_policy_makes(root, tmp_path):
    recorded = in_memory(root).column(CAMERA).float() / 255
    kept = load(root, tmp_path, image_size=24).column(CAMERA).float() / 255
    seen = resize(recorded.unsqueeze(1), 24).squeeze(1)
    assert (seen - kept).abs().max() <= 1.01 / 255
    assert (seen - kept).abs().mean() <= 0.4 / 255  # rounding along rows, and along columns
    assert (seen - kept).mean().abs() <= 0.25 / 255  # torch rounds down a little


def test_a_shrunk_picture_is_augmented_like_the_recorded_one():
    recorded = torch.rand(2, 3, 3, 60, 80).mul(255).byte()
    kept = torch.from_numpy(np.stack([reading.shrink(run.numpy(), 24) for run in recorded]))
    assert kept.shape == (2, 3, 3, 24, 24)
    augment = Augmentation(PlaybyearConfig(augmentation_brightness=0.3, augmentation_hue=0.1, augmentation_scale=0.1))
    torch.manual_seed(0)
    expected = augment(recorded.float() / 255, 24)
    torch.manual_seed(0)
    assert (augment(kept.float() / 255, 24, (60, 80)) - expected).abs().max() < 2 / 255


def test_a_dataset_that_changed_is_another_one_even_if_its_times_and_sizes_say_otherwise(root, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    cache = tmp_path / "cache"

    def identity(folder):
        dataset = open_dataset("tests/noise", folder, video_backend="pyav")
        return dataset_identity(dataset, {CAMERA: dataset.meta.features[CAMERA]}, cache)

    assert identity(copy) == identity(root)
    for path in [*copy.glob("data/*/*.parquet"), *copy.glob("videos/*/*/*.mp4")]:
        before, details = identity(copy), path.stat()
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        os.utime(path, ns=(details.st_atime_ns, details.st_mtime_ns))
        assert path.stat().st_size == details.st_size
        assert path.stat().st_mtime_ns == details.st_mtime_ns
        changed = dataset_identity_of_files(copy, cache)
        assert changed != before["files"], path
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        assert identity(copy) == before


def dataset_identity_of_files(folder, cache):
    from lerobot_playbyear.datasets.identity import _digests

    names = [
        path.relative_to(folder).as_posix() for kind in ("data", "videos") for path in folder.glob(f"{kind}/**/file-*")
    ]
    return _digests(folder, sorted(names), cache / "digests.json")


def test_a_file_is_read_once_for_its_digest(root, tmp_path, monkeypatch):
    import hashlib

    old = tmp_path / "old"
    shutil.copytree(root, old)
    dataset = open_dataset("tests/noise", old, video_backend="pyav")
    features = {CAMERA: dataset.meta.features[CAMERA]}
    monkeypatch.setattr("lerobot_playbyear.datasets.identity._SETTLED_S", -1.0)
    first = dataset_identity(dataset, features, tmp_path / "cache")
    monkeypatch.setattr(hashlib, "file_digest", None)
    assert dataset_identity(dataset, features, tmp_path / "cache") == first


@pytest.mark.parametrize("n_kills", [5, pytest.param(10, marks=pytest.mark.slow)])
def test_a_store_that_was_killed_at_random_times_is_whole(tmp_path, n_kills):
    root = tmp_path / "noise"
    make_dataset(root, (60, 90, 40), image_size=96, use_videos=True, sample_rate=2000)
    command = [
        sys.executable,
        str(Path(__file__).with_name("disk_forks.py")),
        str(root),
        str(tmp_path / "cache"),
        str(n_kills),
        "0",
    ]
    process = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    answer = json.loads(process.stdout.splitlines()[-1])
    assert answer["wrong"] == []
    assert answer["frames"] == 190
    assert answer["finished_early"] < n_kills, "no kill hit"
    assert not list((tmp_path / "cache").glob("*.part"))


def test_what_was_cut_off_is_gone_on_with_and_never_read(root, tmp_path, monkeypatch):
    pieces = reading._pieces
    monkeypatch.setattr(disk_columns, "_SAVED_EVERY_S", 0.0)
    monkeypatch.setattr("lerobot_playbyear.datasets.tensors._PICTURES_AT_ONCE", 5)
    monkeypatch.setattr("lerobot_playbyear.datasets.tensors._ROWS_AT_ONCE", 5)

    def fails_on_the_way(*args):
        for number, piece in enumerate(pieces(*args)):
            if number == 3:
                raise KeyboardInterrupt
            yield piece

    monkeypatch.setattr(reading, "_pieces", fails_on_the_way)
    with pytest.raises(KeyboardInterrupt):
        load(root, tmp_path)
    (part,) = folders(tmp_path)
    assert part.suffix == ".part"
    began = {}

    def notes_where_it_begins(*args):
        began[args[-2]] = args[-1]
        yield from pieces(*args)

    monkeypatch.setattr(reading, "_pieces", notes_where_it_begins)
    store = load(root, tmp_path)
    assert began[CAMERA] == 12  # two pieces of 5, and the rest of the first episode
    assert_same(store, in_memory(root))


@pytest.fixture
def with_nan(tmp_path):
    """A dataset whose sound, as floats, and state hold one NaN in the fourth row."""
    features = dataset_features(image_size=SIZE)
    features[MICROPHONE]["dtype"] = "float32"
    make_dataset(tmp_path / "noise", LENGTHS, features=features)
    (path,) = (tmp_path / "noise").glob("data/*/*.parquet")
    table = pq.read_table(path)
    for key in (MICROPHONE, "observation.state"):
        field = table.schema.field(key)
        values = np.array(table[key].to_pylist(), np.float32)
        values[3, 2] = np.nan
        table = table.set_column(table.column_names.index(key), field, pa.array(values.tolist(), field.type))
    pq.write_table(table, path)
    return tmp_path / "noise"


@pytest.mark.parametrize(
    ("key", "rates"), [("observation.state", None), (MICROPHONE, None), (MICROPHONE, {MICROPHONE: 8000})]
)
def test_nan_is_refused_by_every_run(with_nan, tmp_path, key, rates):
    for _ in range(3):
        with pytest.raises(ValueError, match=f"'{key}' holds NaN"):
            load(with_nan, tmp_path / "cache", keys=[key], sample_rates=rates)


@pytest.mark.parametrize(
    ("key", "rates"), [("observation.state", None), (MICROPHONE, None), (MICROPHONE, {MICROPHONE: 8000})]
)
def test_nan_that_was_written_before_the_run_was_cut_off_is_refused(with_nan, tmp_path, monkeypatch, key, rates):
    pieces = reading._pieces
    monkeypatch.setattr(disk_columns, "_SAVED_EVERY_S", 0.0)
    monkeypatch.setattr("lerobot_playbyear.datasets.tensors._VALUES_AT_ONCE", 7)  # one row
    monkeypatch.setattr("lerobot_playbyear.datasets.resampling._SAMPLES_AT_ONCE", 1)

    def fails_on_the_way(*args):
        for number, piece in enumerate(pieces(*args)):
            if args[-2] == key and number == 20:
                raise KeyboardInterrupt
            yield piece

    with monkeypatch.context() as patch:
        patch.setattr(reading, "_pieces", fails_on_the_way)
        with pytest.raises(KeyboardInterrupt):
            load(with_nan, tmp_path / "cache", keys=[key], sample_rates=rates)
    with pytest.raises(ValueError, match=f"'{key}' holds NaN"):
        load(with_nan, tmp_path / "cache", keys=[key], sample_rates=rates)


@pytest.mark.parametrize("damage", ["shortened", "removed", "manifest"])
def test_a_finished_store_that_was_damaged_since_is_made_anew(root, tmp_path, caplog, damage):
    load(root, tmp_path)
    (folder,) = folders(tmp_path)
    victim = folder / ("manifest.json" if damage == "manifest" else "0.npy")
    if damage == "removed":
        victim.unlink()
    else:
        victim.write_bytes(victim.read_bytes()[:-20])
    with caplog.at_level(logging.WARNING):
        assert_same(load(root, tmp_path), in_memory(root))
    assert "made anew" in caplog.text


def test_two_at_once_make_one_and_share_it(root, tmp_path, monkeypatch):
    made = []
    original = disk_columns._make
    monkeypatch.setattr(disk_columns, "_make", lambda *args: (made.append(1), original(*args)))
    stores = []
    threads = [threading.Thread(target=lambda: stores.append(load(root, tmp_path))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    assert_same(stores[0], stores[1])


def test_too_little_room_is_told_before_anything_is_decoded(root, tmp_path, monkeypatch, no_decoding):
    no_decoding()
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(CacheError, match=r"need .* GiB on the disk of .*--store\.cache"):
        load(root, tmp_path)


def test_a_disk_that_fills_up_costs_nothing_that_was_decoded(root, tmp_path, monkeypatch):
    monkeypatch.setattr(disk_columns, "_SAVED_EVERY_S", 0.0)
    fsync, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(CacheError, match="became full"):
            load(root, tmp_path)
    assert_same(load(root, tmp_path), in_memory(root))


def test_a_folder_that_cannot_be_written_is_named(root, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CacheError, match=r"file.*--store\.cache"):
        load(root, tmp_path / "file")


def test_a_dataset_that_cannot_be_read_now_is_no_fault_of_the_folder(root, tmp_path, monkeypatch):
    """Nothing is said of --store.cache; what was decoded before stays, and the next run goes on."""
    pieces = reading._pieces
    monkeypatch.setattr(disk_columns, "_SAVED_EVERY_S", 0.0)

    def fails(*args):
        yield from pieces(*args)
        if args[-2] == CAMERA:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(root / "videos" / "file.mp4"))

    with monkeypatch.context() as patch:
        patch.setattr(reading, "_pieces", fails)
        with pytest.raises(OSError, match=r"Input/output error.*file\.mp4") as raised:
            load(root, tmp_path)
    assert not isinstance(raised.value, CacheError)
    assert_same(load(root, tmp_path), in_memory(root))


def test_an_unknown_place_is_refused(root):
    dataset = open_dataset("tests/noise", root, video_backend="pyav")
    with pytest.raises(ValueError, match="--store=tape is not known: wanted one of memory, disk, auto"):
        reading.choose_place("tape", dataset)


def test_auto_takes_memory_while_the_frames_fit(root, monkeypatch):
    dataset = open_dataset("tests/noise", root, video_backend="pyav")
    assert reading.choose_place("auto", dataset) == "memory"
    monkeypatch.setattr(reading, "available_memory", lambda: 100_000)
    assert reading.choose_place("auto", dataset) == "disk"
    assert reading.choose_place("memory", dataset) == "memory"


def test_appended_pictures_are_shrunk_like_those_of_the_disk(tmp_path):
    dataset = make_dataset(tmp_path / "noise", (6,), image_size=SIZE)
    disk = load(tmp_path / "noise", tmp_path / "cache", image_size=IMAGE_SIZE)
    own = in_memory(tmp_path / "noise", image_size=IMAGE_SIZE)
    features = {key: dataset.features[key] for key in dataset.features if key in own.keys and "index" not in key}
    features.pop("timestamp")
    frame = random_frame(features, np.random.default_rng(1))
    own.append_episode([frame, frame])
    assert own.column(CAMERA).shape == (8, 3, IMAGE_SIZE, IMAGE_SIZE)
    expected = reading.shrink(frame[CAMERA].transpose(2, 0, 1)[None], IMAGE_SIZE)
    assert np.array_equal(own.column(CAMERA)[-1].numpy(), expected[0])
    assert torch.equal(own.column(CAMERA)[:6], disk.column(CAMERA))
