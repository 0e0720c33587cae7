"""The store hands out what LeRobot's loader would, from memory as from the disk; and runs are drawn as promised."""

import errno
import logging
import math
import os
import random
import shutil
import signal
import threading
import time

import numpy as np
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, TASK, audio_feature, dataset_features, make_dataset
from lerobot.datasets import LeRobotDataset
from recording_factory import load as recorded_dataset
from support.failing import fail_once
from support.recording import edit_column, writer
from torch.utils.data import default_collate

from lerobot_playbyear.datasets.pictures import shrink
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.policy.image_augmentation import Augmentation, resize
from lerobot_playbyear.training import EpisodeStore, RunSampler, frame_cache, run_weights
from lerobot_playbyear.training import store as store_module
from lerobot_playbyear.training.frame_cache import CacheError

FPS = 20
LENGTHS = (12, 17, 9)
SIZE = 32
DELTAS = {CAMERA: range(-4, 1), MICROPHONE: range(-20, 1), "observation.state": range(-20, 1), "action": range(-3, 3)}


@pytest.fixture(scope="module", params=[False, True], ids=["image", "video"])
def root(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noise"
    make_dataset(root, LENGTHS, image_size=SIZE, use_videos=request.param)
    return root


def open_stock(root, episodes=None):
    timestamps = {key: [delta / FPS for delta in deltas] for key, deltas in DELTAS.items()}
    return LeRobotDataset("tests/noise", root, episodes=episodes, delta_timestamps=timestamps, video_backend="pyav")


@pytest.mark.parametrize("episodes", [None, [0, 2]])
def test_windows_are_those_of_lerobot_as_bytes_and_pcm(root, episodes):
    stock = open_stock(root, episodes)
    store = EpisodeStore.from_dataset(stock, device="cpu")
    last = [0, 5, 11, 12, 14, len(stock) - 1]

    batch = store.windows(last, DELTAS)

    expected = default_collate([stock[i] for i in last])
    assert (batch[CAMERA].dtype, batch[MICROPHONE].dtype) == (torch.uint8, torch.int16)
    batch |= {CAMERA: batch[CAMERA].float() / 255, MICROPHONE: batch[MICROPHONE].long()}
    assert batch.keys() == {*DELTAS, *(f"{key}_is_pad" for key in DELTAS), "task"}
    assert batch.pop("task") == expected["task"] == [TASK] * len(last)
    for key, values in batch.items():
        assert torch.equal(values, expected[key]), key


# On the disk


def load(root, cache, **options):
    return in_memory(root, place="disk", cache=cache, **options)


def in_memory(root, episodes=None, **options):
    return EpisodeStore.from_dataset(DatasetReader("tests/noise", root, episodes), device="cpu", **options)


def assert_same(store, other):
    assert store.keys == other.keys
    for key in store.keys:
        assert torch.equal(store.column(key), other.column(key)), key


def folders(cache):
    return sorted(path for path in cache.iterdir() if path.is_dir())


@pytest.fixture
def decoded(monkeypatch):
    """The columns that are decoded from now on; a test may put what happens to one under its name."""
    pieces, seen = store_module._pieces, {}

    def counted(*args):
        key = args[-1]
        then = seen.get(key)
        seen[key] = None
        yield from pieces(*args)
        if then is not None:
            raise then

    monkeypatch.setattr(store_module, "_pieces", counted)
    return seen


@pytest.mark.parametrize("image_size", [None, 24])
def test_the_disk_holds_what_memory_would_and_a_second_run_decodes_nothing(root, tmp_path, decoded, image_size):
    expected = in_memory(root, image_size=image_size)
    assert_same(load(root, tmp_path, image_size=image_size), expected)
    decoded.clear()
    assert_same(load(root, tmp_path, image_size=image_size), expected)
    assert load(root, tmp_path, image_size=image_size).column(CAMERA).shape[-1] == (image_size or SIZE)
    assert not decoded
    assert_same(load(root, tmp_path, episodes=[0, 2]), in_memory(root, episodes=[0, 2]))
    assert len(folders(tmp_path)) == 2


def test_shrunk_pictures_are_those_that_the_policy_makes_and_augments(root, tmp_path):
    recorded = in_memory(root).column(CAMERA).float() / 255
    kept = load(root, tmp_path, image_size=24).column(CAMERA).float() / 255
    seen = resize(recorded.unsqueeze(1), 24).squeeze(1)
    assert (seen - kept).abs().max() <= 1.01 / 255
    assert (seen - kept).abs().mean() <= 0.4 / 255  # rounding along rows, and along columns
    assert (seen - kept).mean().abs() <= 0.25 / 255  # torch rounds down a little
    large = torch.rand(2, 3, 3, 60, 80).mul(255).byte()
    small = torch.from_numpy(np.stack([shrink(run.numpy(), 24) for run in large]))
    augment = Augmentation(PlaybyearConfig(augmentation_brightness=0.3, augmentation_hue=0.1, augmentation_scale=0.1))
    torch.manual_seed(0)
    expected = augment(large.float() / 255, 24)
    torch.manual_seed(0)
    assert (augment(small.float() / 255, 24, (60, 80)) - expected).abs().max() < 2 / 255


def test_a_dataset_that_changed_is_another_one_even_if_its_times_and_sizes_say_otherwise(root, tmp_path):
    copy, cache = tmp_path / "copy", tmp_path / "cache"
    shutil.copytree(root, copy)
    for number, path in enumerate([*copy.glob("data/*/*.parquet"), *copy.glob("videos/*/*/*.mp4")], 1):
        load(copy, cache)
        assert len(folders(cache)) == number
        details, content = path.stat(), path.read_bytes()
        path.write_bytes(content)
        os.utime(path, ns=(details.st_atime_ns, details.st_mtime_ns))
        assert path.stat().st_mtime_ns == details.st_mtime_ns
    load(copy, cache)
    assert len(folders(cache)) == number + 1


def filled(root, cache) -> int:
    """The number of a child that fills the store."""
    child = os.fork()
    if child == 0:
        try:
            torch.set_num_threads(1)
            load(root, cache, image_size=24)
        finally:
            os._exit(0)
    return child


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork")
@pytest.mark.parametrize("n_kills", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_a_store_that_was_killed_at_random_times_is_whole(tmp_path, n_kills):
    root, cache, draw = tmp_path / "noise", tmp_path / "cache", random.Random(0)
    make_dataset(root, (40, 50, 30), image_size=96, use_videos=True, sample_rate=2000)
    began = time.monotonic()
    os.waitpid(filled(root, tmp_path / "undisturbed"), 0)
    took, n_hit = time.monotonic() - began, 0
    while n_hit < n_kills:
        child = filled(root, cache)
        time.sleep(draw.uniform(0.1, 0.6) * took)
        os.kill(child, signal.SIGKILL)
        if os.WIFSIGNALED(os.waitpid(child, 0)[1]):
            n_hit += 1
        else:  # it was done before: the first run had been slowed down
            shutil.rmtree(cache)
            took /= 2
    assert_same(load(root, cache, image_size=24), in_memory(root, image_size=24))
    assert not list(cache.glob("*/*.part"))


@pytest.fixture(scope="module")
def with_nan(tmp_path_factory):
    """A dataset whose sound, as floats, and state hold one NaN in the fourth row."""
    features = dataset_features(image_size=SIZE)
    features[MICROPHONE]["dtype"] = "float32"
    root = tmp_path_factory.mktemp("nan") / "noise"
    make_dataset(root, LENGTHS, features=features)
    (path,) = root.glob("data/*/*.parquet")
    for key in (MICROPHONE, "observation.state"):
        edit_column(path, key, lambda rows: [*rows[:3], [*rows[3][:2], math.nan, *rows[3][3:]], *rows[4:]])
    return root


@pytest.mark.parametrize("options", [{}, {"place": "disk"}, {"place": "disk", "sample_rates": {MICROPHONE: 8000}}])
def test_nan_is_refused_by_every_run_with_the_episode_that_holds_it(with_nan, tmp_path, options):
    options = {**options, "cache": tmp_path / "cache"} if options else {}
    for key in (MICROPHONE,) if "sample_rates" in options else (MICROPHONE, "observation.state"):
        for _ in range(2):
            with pytest.raises(ValueError, match=rf"'{key}' holds NaN .* in episode 0 of 3"):
                in_memory(with_nan, keys=[key], **options)


@pytest.mark.parametrize("damage", ["shortened", "removed"])
def test_a_column_that_was_damaged_since_is_made_anew(noise, tmp_path, caplog, damage):
    load(noise, tmp_path)
    victim = folders(tmp_path)[0] / "0.npy"
    content = victim.read_bytes()[:-20]
    victim.unlink()
    if damage == "shortened":
        victim.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert_same(load(noise, tmp_path), in_memory(noise))
    assert ("made again" in caplog.text) is (damage == "shortened")


def test_two_at_once_make_one_and_share_it(noise, tmp_path, monkeypatch):
    made, original = [], frame_cache._write_column
    monkeypatch.setattr(frame_cache, "_write_column", lambda *args: (made.append(args[1]), original(*args)))
    stores = []
    threads = [threading.Thread(target=lambda: stores.append(load(noise, tmp_path))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == len(set(made)) > 0
    assert_same(stores[0], stores[1])


def test_too_little_room_is_told_before_anything_is_decoded(noise, tmp_path, monkeypatch, decoded):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=1000))
    with pytest.raises(CacheError, match=r"need .* GiB on the disk of .*--store\.cache"):
        load(noise, tmp_path)
    assert not decoded


def test_a_disk_that_fills_up_costs_no_column_that_was_complete(noise, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        fail_once(patch, os, "fsync", 6, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        with pytest.raises(CacheError, match="became full"):
            load(noise, tmp_path)
    assert list(folders(tmp_path)[0].glob("*.npy"))
    assert_same(load(noise, tmp_path), in_memory(noise))


def test_a_folder_that_cannot_be_written_is_named_and_an_unreadable_dataset_is_no_fault_of_it(noise, tmp_path, decoded):
    (tmp_path / "file").write_text("")
    with pytest.raises(CacheError, match=r"file.*--store\.cache"):
        load(noise, tmp_path / "file")
    decoded[CAMERA] = OSError(errno.EIO, os.strerror(errno.EIO), str(noise / "videos" / "file.mp4"))
    with pytest.raises(OSError, match=r"Input/output error.*file\.mp4") as raised:
        load(noise, tmp_path / "cache")
    assert not isinstance(raised.value, CacheError)
    assert_same(load(noise, tmp_path / "cache"), in_memory(noise))


def test_auto_takes_memory_while_the_frames_fit(noise, tmp_path, monkeypatch):
    assert in_memory(noise, place="auto").place == "memory"
    n_bytes = in_memory(noise).nbytes
    monkeypatch.setattr(store_module, "available_memory", lambda: 2 * n_bytes - 1000)
    assert in_memory(noise, place="auto", cache=tmp_path).place == "disk"
    assert in_memory(noise).place == "memory"


# Sound at another rate

RATE_LENGTHS = (7, 12)
HERTZ = (440.0, 1330.0)  # an episode each, so that what leaks into its neighbour is seen
LEVEL = 0.4
REACH = 80  # samples at 16 kHz that the resampler's filter sees


def tone(rate: int, episode: int, hertz=HERTZ) -> np.ndarray:
    """(n,) in [-1, 1], cut off where it is loud."""
    time = np.arange(RATE_LENGTHS[episode] * rate // FPS) / rate
    return LEVEL * np.cos(2 * np.pi * hertz[episode] * time + 0.3)


def write(root, rate: int, dtype: str = "int16", hertz=HERTZ, level: float = 1.0) -> LeRobotDataset:
    features = {
        MICROPHONE: {**audio_feature(rate, FPS), "dtype": dtype},
        "observation.state": {"dtype": "float32", "shape": (2,), "names": None},
        "action": {"dtype": "float32", "shape": (2,), "names": None},
    }
    with writer(root, features) as target:
        for episode, length in enumerate(RATE_LENGTHS):
            samples = (level * tone(rate, episode, hertz)).clip(-1, 32767 / 32768).reshape(length, -1)
            samples = np.round(samples * 32768).astype(np.int16) if dtype == "int16" else samples.astype(dtype)
            for i, block in enumerate(samples):
                low = np.full(2, i, np.float32)
                target.add_frame({MICROPHONE: block, "observation.state": low, "action": low, "task": TASK})
            target.save_episode()
    return recorded_dataset(root)


@pytest.fixture(scope="module")
def tones(tmp_path_factory) -> dict[int, LeRobotDataset]:
    folder = tmp_path_factory.mktemp("tones")
    return {rate: write(folder / str(rate), rate) for rate in (16000, 44100, 48000)}


def at(dataset, rate=None, **options) -> EpisodeStore:
    rates = None if rate is None else {MICROPHONE: rate}
    return EpisodeStore.from_dataset(dataset, device="cpu", sample_rates=rates, **options)


@pytest.mark.parametrize(("recorded", "wanted"), [(48000, 16000), (16000, 48000), (44100, 16000)])
def test_windows_are_those_that_the_other_rate_would_have_recorded(tones, recorded, wanted):
    deltas = {MICROPHONE: range(-30, 1), "observation.state": [0]}
    last = [0, 3, 6, 7, 12, 18]  # first, middle and last frame of both episodes
    store = at(tones[recorded], wanted)
    batch, expected = store.windows(last, deltas), at(tones[wanted]).windows(last, deltas)

    assert batch[MICROPHONE].dtype == torch.int16
    assert torch.equal(batch[f"{MICROPHONE}_is_pad"], expected[f"{MICROPHONE}_is_pad"])
    assert torch.equal(batch["observation.state"], expected["observation.state"])
    wrong = (batch[MICROPHONE].int() - expected[MICROPHONE].int()).abs()
    if wanted > recorded:  # an episode's last sample stands for more than one, which nobody heard
        wrong = wrong[..., : 1 - wanted // recorded]
    assert wrong.max() <= 0.02 * LEVEL * 32768
    for episode, (start, end) in enumerate(zip(store.starts, store.ends, strict=True)):
        wrong = store.column(MICROPHONE)[start:end].reshape(-1).numpy() - tone(wanted, episode) * 32768
        edge = REACH * wanted // 16000
        assert np.abs(wrong[edge:-edge]).max() <= 3  # only edges differ by more than rounding


def test_sound_at_full_scale_is_cut_off_and_does_not_turn_over(tmp_path):
    sound = at(write(tmp_path / "loud", 48000, hertz=(100.0, 100.0), level=50.0), 16000).column(MICROPHONE)
    assert (sound.max(), sound.min()) == (32767, -32768)  # a band-limited square reaches further than the square
    square = np.sign(np.concatenate([tone(16000, episode, (100.0, 100.0)) for episode in (0, 1)]))
    assert (np.sign(sound.reshape(-1).numpy()) == square).mean() > 0.95


def test_floats_stay_floats_and_the_disk_has_a_folder_for_each_rate(tones, tmp_path):
    store = at(write(tmp_path / "floats", 48000, "float32"), 16000)
    assert store.column(MICROPHONE).dtype == torch.float32
    assert np.abs(store.column(MICROPHONE)[:7].reshape(-1).numpy() - tone(16000, 0)).max() < 0.01 * LEVEL
    for number, rate in enumerate((48000, 16000, 8000), 1):
        kept = at(tones[48000], rate, place="disk", cache=tmp_path / "cache")
        assert torch.equal(kept.column(MICROPHONE), at(tones[48000], rate).column(MICROPHONE))
        assert len(folders(tmp_path / "cache")) == number


# What is drawn


def make_store(*lengths):
    """A store of frames that are nothing but their number."""
    ends = np.cumsum(lengths).tolist()
    return EpisodeStore({"action": torch.arange(ends[-1]).float()[:, None]}, [0, *ends[:-1]], ends, FPS)


def coverage(store, weights, n_windows, n_draws=200, batch_size=64):
    """How often each frame is learned from, relative to the mean."""
    sampler = RunSampler(weights, seed=0)
    counts = torch.zeros(len(store))
    for number in range(n_draws):
        last = sampler.draw(batch_size, number)
        for delta in range(n_windows):
            counts.index_add_(0, last - delta, torch.ones(batch_size))
    return counts / counts.mean()


@pytest.mark.parametrize("n_windows", [4, 8])
def test_runs_neglect_neither_the_first_nor_the_last_frames(n_windows):
    store = make_store(60, 40)

    covered = coverage(store, run_weights(store, n_windows), n_windows)

    for edge in (covered[:n_windows], covered[60 : 60 + n_windows], covered[60 - n_windows : 60], covered[-n_windows:]):
        assert 0.8 < edge.mean() < 1.2
        assert edge.min() > 0.4


def test_runs_never_reach_out_of_their_episode_unless_it_is_shorter():
    weights = run_weights(make_store(10, 3), 4)

    assert weights[:3].eq(0).all()
    assert weights[3:10].gt(0).all()
    assert weights[10:].tolist() == [0, 0, 3]
    assert weights.sum() == 13


def test_a_batch_comes_from_as_many_episodes_as_possible_and_depends_on_its_number_alone():
    weights = run_weights(make_store(*[20] * 8))
    first, again = RunSampler(weights, seed=3), RunSampler(weights, seed=3)
    assert len((first.draw(16, 0) // 20).unique()) == 8
    assert torch.equal(first.draw(8, 4), again.draw(8, 4))
    assert not torch.equal(first.draw(8, 4), again.draw(8, 5))
