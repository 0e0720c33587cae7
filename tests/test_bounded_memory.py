"""What reads or records a dataset holds a bounded part of it; statistics are those that LeRobot has of all in memory."""

import tracemalloc

import numpy as np
import psutil
import pytest
from dataset_factory import CAMERA, make_dataset
from lerobot.datasets.compute_stats import get_feature_stats

from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.datasets.statistics import sound_stats
from lerobot_playbyear.film import video
from lerobot_playbyear.film.video import encode
from lerobot_playbyear.training import EpisodeStore

FPS = 30


def test_the_store_compares_what_it_needs_with_the_memory_that_is_free(tmp_path):
    dataset = make_dataset(tmp_path / "data", (5,), image_size=16)
    memory = psutil.virtual_memory()
    assert memory.available < memory.total
    needed = (memory.available + memory.total) // 2
    dataset.meta.features["observation.state"]["shape"] = (needed // 4 // 5,)
    with pytest.raises(MemoryError, match=r"GiB are free.*--dataset\.episodes"):
        EpisodeStore.from_dataset(dataset, device="cpu")


@pytest.mark.parametrize("version", [1, 2])
def test_a_containers_limit_counts_as_the_memory_that_is_free(tmp_path, version):
    (tmp_path / "proc/self").mkdir(parents=True)
    lines = {1: "4:cpu:/\n3:memory:/docker/abc\n", 2: "0::/docker/abc\n"}
    (tmp_path / "proc/self/cgroup").write_text(lines[version])
    group = tmp_path / "groups" / ("memory" if version == 1 else "")  # as a container sees it: its own group is the top
    group.mkdir(parents=True)
    limit, usage = (
        ("memory.limit_in_bytes", "memory.usage_in_bytes") if version == 1 else ("memory.max", "memory.current")
    )
    cached = "total_inactive_file" if version == 1 else "inactive_file"
    (group / limit).write_text("3000000\n")
    (group / usage).write_text("2500000\n")
    (group / "memory.stat").write_text(f"anon 100\n{cached} 400000\n")
    assert available_memory(tmp_path / "proc", tmp_path / "groups") == 900000
    (group / limit).write_text("max\n" if version == 2 else str(2**63 - 4096))
    assert available_memory(tmp_path / "proc", tmp_path / "groups") > 900000


@pytest.mark.slow
@pytest.mark.parametrize("use_videos", [False, True], ids=["image", "video"])
def test_pictures_of_a_long_episode_come_a_few_at_a_time(tmp_path, use_videos):
    n_frames, size = 400, 128
    make_dataset(tmp_path / "data", (n_frames,), image_size=size, use_videos=use_videos, microphones=())
    reader = DatasetReader("tests/noise", tmp_path / "data")
    tracemalloc.start()
    n_read = sum(1 for _ in reader.pictures(CAMERA, reader.episodes[0]))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert n_read == n_frames
    assert peak < n_frames * 3 * size**2 / 2  # of all of them


@pytest.mark.parametrize("kind", ["quiet", "loud", "constant", "one sample", "clipped"])
@pytest.mark.parametrize("dtype", [np.int16, np.float32])
def test_statistics_of_sound_are_those_that_lerobot_has_of_all_samples(kind, dtype):
    rng = np.random.default_rng(0)
    shape = (1, 1) if kind == "one sample" else (1500, 800)
    samples = rng.normal(3, {"quiet": 20, "clipped": 30000}.get(kind, 3000), shape)
    samples = np.clip(np.full(shape, 7.0) if kind == "constant" else samples, -32768, 32767)
    waveform = samples.astype(np.int16) if dtype is np.int16 else (samples / 32768).astype(np.float32)
    ours = sound_stats(waveform)
    lerobots = get_feature_stats(waveform.astype(np.float64).reshape(-1, 1), axis=0, keepdims=False)
    assert set(ours) == set(lerobots)
    assert ours.pop("count") == [len(waveform)]
    bin_width = float(np.ptp(waveform.astype(np.float64))) / 5000  # of LeRobot's histograms
    for name, value in ours.items():
        assert value.shape == (shape[1],)
        near = (dtype is np.int16) + bin_width if name.startswith("q") else 1e-9  # ours are exact
        assert value[0] == pytest.approx(float(lerobots[name][0]), rel=1e-4, abs=near), name


def test_the_film_of_a_very_long_episode_is_coarser_so_that_a_browser_can_hold_it(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (120, 160, 3), dtype=np.uint8) for _ in range(90)]
    sizes = []
    for limit in (2**28, 300_000):
        monkeypatch.setattr(video, "_MOST_BYTES", limit)
        sizes.append(encode(tmp_path / f"{limit}.mp4", iter(pictures), 90, FPS, [], 1.0).stat().st_size)
    assert sizes[0] > 2 * 300_000
    assert sizes[1] < 1.5 * 300_000
