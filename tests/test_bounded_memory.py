"""What reads or records a dataset holds a bounded part of it, and finds and writes the same as if it had all in memory."""

import io
import json
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from dataset_factory import CAMERA, MICROPHONE, make_dataset
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.video_utils import FrameTimestampError, decode_video_frames
from PIL import Image
from test_attach_audio import config as attach_config
from test_attach_audio import silent_dataset, write_sounds

from lerobot_playbyear.audio import attached_sound
from lerobot_playbyear.audio.attach import attach_audio
from lerobot_playbyear.datasets import EpisodeStore, audio_feature, opening, parquet, resample
from lerobot_playbyear.datasets.audio_files import Resampled
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.datasets.free_memory import available_memory
from lerobot_playbyear.datasets.long_dataset import LongDataset
from lerobot_playbyear.datasets.opening import open_dataset
from lerobot_playbyear.datasets.parquet import with_values
from lerobot_playbyear.datasets.tensors import image_pieces, video_pieces
from lerobot_playbyear.datasets.video_pictures import video_pictures
from lerobot_playbyear.film.dataset_film import encode

FPS, RATE = 30, 48000
BLOCK = RATE // FPS
LONG = 4000  # frames: 6.4 million samples


def peak_of_arrays(work: Callable[[], object]) -> int:
    """The most bytes of Python's and NumPy's memory that some work needs besides what is there."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def peak_of_process(work: Callable[[], object]) -> int:
    """The most bytes that this process grows by meanwhile."""
    done, process = threading.Event(), psutil.Process()
    before = peak = process.memory_info().rss

    def look() -> None:
        nonlocal peak
        while not done.wait(0.005):
            peak = max(peak, process.memory_info().rss)

    watcher = threading.Thread(target=look)
    watcher.start()
    work()
    done.set()
    watcher.join()
    return peak - before


@pytest.fixture
def small_pieces(monkeypatch):
    """Pieces of 16 kB, so that a short episode has many."""
    for module in (parquet, attached_sound):
        monkeypatch.setattr(module, "PIECE_BYTES", 2**14)


@pytest.fixture
def megabyte_pieces(monkeypatch):
    for module in (parquet, attached_sound):
        monkeypatch.setattr(module, "PIECE_BYTES", 2**20)


@pytest.fixture(scope="module")
def long_sound(tmp_path_factory) -> Path:
    """One episode with minutes of noise."""
    root = tmp_path_factory.mktemp("long") / "dataset"
    features = {MICROPHONE: audio_feature(RATE, FPS), "action": {"dtype": "float32", "shape": (2,), "names": None}}
    rng = np.random.default_rng(0)
    with DurableWriter("tests/long", root, FPS, features) as writer:
        for _ in range(LONG):
            block = rng.integers(-300, 300, BLOCK).astype(np.int16)
            writer.add_frame({MICROPHONE: block, "action": rng.random(2).astype(np.float32), "task": "listen"})
        writer.save_episode()
    return root


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


def write_video(path: Path, n_frames: int, size: tuple[int, int], **options: str) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.height, stream.width = size
        stream.pix_fmt, stream.options = "yuv420p", {"preset": "ultrafast", **options}
        for i in range(n_frames):
            shifted = np.ascontiguousarray(np.roll(picture, 3 * i, axis=1))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shifted, "rgb24")))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("options", [{"g": "2"}, {"g": "1000", "bf": "3", "preset": "fast"}], ids=["g=2", "B-frames"])
def test_pictures_that_are_decoded_one_by_one_are_those_of_lerobot(tmp_path, options):
    write_video(tmp_path / "film.mp4", 90, (48, 64), **options)
    times = [(20 + i) / FPS + 2e-5 for i in range(60)] + [79 / FPS]
    expected = decode_video_frames(tmp_path / "film.mp4", times, 1e-4, "pyav", return_uint8=True)
    pictures = np.stack(list(video_pictures(tmp_path / "film.mp4", times, 1e-4, "pyav")))
    np.testing.assert_array_equal(pictures, expected.permute(0, 2, 3, 1))
    for wrong in ([1.01], [2.9, 3.1], [50.0]):
        with pytest.raises(FrameTimestampError, match=r"film\.mp4"):
            list(video_pictures(tmp_path / "film.mp4", wrong, 1e-4, "pyav"))


def test_reading_a_long_video_holds_its_tensor_and_little_else(tmp_path):
    make_dataset(tmp_path / "data", (2,), image_size=16, use_videos=True)
    dataset = LeRobotDataset("tests/noise", tmp_path / "data", video_backend="pyav")
    n_frames, size = 900, (240, 320)
    (path,) = tmp_path.rglob("*.mp4")
    write_video(path, n_frames, size, g=str(FPS))
    dataset.meta.features[CAMERA]["shape"] = (*size, 3)
    columns = {
        "episode_index": np.zeros(n_frames, np.int64),
        "timestamp": (np.arange(n_frames) / FPS).astype(np.float32),
    }
    dataset.reader.hf_dataset = type(dataset.hf_dataset)(pa.table(columns))
    from lerobot_playbyear.datasets.reading import _gathered

    kept: list[torch.Tensor] = []
    grown = peak_of_process(lambda: kept.append(_gathered(video_pieces(dataset, CAMERA, 0, "pyav"), n_frames)))
    assert kept[0].shape == (n_frames, 3, *size)
    assert grown < 1.5 * kept[0].nbytes


def test_large_pictures_are_decoded_a_few_at_a_time(tmp_path):
    n_frames, size = 100, 1024
    make_dataset(tmp_path / "data", (n_frames,), image_size=16)
    (path,) = (tmp_path / "data").glob("data/*/*.parquet")
    picture = io.BytesIO()
    Image.new("RGB", (size, size), (250, 5, 120)).save(picture, "PNG")
    rows = [{"bytes": picture.getvalue(), "path": None}] * n_frames
    pq.write_table(with_values(pq.read_table(path), CAMERA, rows), path)
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    info["features"][CAMERA]["shape"] = [size, size, 3]
    (tmp_path / "data/meta/info.json").write_text(json.dumps(info))
    dataset = LeRobotDataset("tests/noise", tmp_path / "data")
    lengths: list[int] = []
    grown = peak_of_arrays(lambda: lengths.extend(len(piece) for piece in image_pieces(dataset, CAMERA)))
    assert sum(lengths) == n_frames
    assert grown < n_frames * 3 * size**2 / 2  # of all of them


@pytest.mark.parametrize(("old", "new"), [(44100, 48000), (48000, 16000), (11025, 48000), (16000, 16000)])
def test_sound_that_is_resampled_in_pieces_has_no_seams(old, new):
    sound = np.random.default_rng(0).integers(-9000, 9000, (old // 2 + 77, 2)).astype(np.int16)
    whole, lazy = resample(sound, old, new), Resampled(sound, old, new)
    assert lazy.shape == whole.shape
    for start in range(0, len(whole), 3001):
        piece = lazy[start : start + 3001].astype(int)
        assert np.abs(piece - whole[start : start + 3001]).max() <= 1


def test_attaching_in_pieces_gives_the_same_dataset_and_holds_no_file(tmp_path, small_pieces):
    silent_dataset(tmp_path / "silent")
    files = write_sounds(tmp_path / "sound")
    in_pieces = attach_audio(attach_config(tmp_path / "silent", tmp_path / "pieces", files))
    for module in (parquet, attached_sound):
        module.PIECE_BYTES = 2**26  # put back by the fixture
    at_once = attach_audio(attach_config(tmp_path / "silent", tmp_path / "once", files))
    tables = [pq.read_table(root / "data") for root in (in_pieces, at_once)]
    assert tables[0].equals(tables[1])
    assert pq.read_table(in_pieces / "meta/episodes").equals(pq.read_table(at_once / "meta/episodes"))
    assert (in_pieces / "meta/stats.json").read_text() == (at_once / "meta/stats.json").read_text()


def test_attaching_takes_no_memory_that_grows_with_the_sound(tmp_path, long_sound, megabyte_pieces):
    from lerobot_playbyear.datasets import write_audio

    sound = np.random.default_rng(0).integers(-300, 300, LONG * BLOCK).astype(np.int16)
    path = write_audio(tmp_path / "sound" / "0.wav", sound, RATE)
    n_bytes = path.stat().st_size
    del sound
    cfg = attach_config(long_sound, tmp_path / "heard", f"{path.parent}/{{episode}}.wav", microphone="table", offset=0)
    assert peak_of_arrays(lambda: attach_audio(cfg)) < n_bytes


def test_a_damaged_row_group_gives_no_rows_however_large_it_is(tmp_path, small_pieces):
    rows = np.random.default_rng(0).integers(-9000, 9000, (200, 400)).astype(np.int16)
    table = pa.table({"sound": pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), 400)})
    path = tmp_path / "data.parquet"
    pq.write_table(table, path, row_group_size=100, write_page_checksum=True, use_dictionary=False, data_page_size=4096)
    offset = pq.read_metadata(path).row_group(1).column(0).data_page_offset
    content = bytearray(path.read_bytes())
    content[offset + 60000] ^= 1
    path.write_bytes(content)
    with parquet.open_checked(path) as file:
        found = list(parquet.read_row_groups(file))
    good = [part for part in found if isinstance(part, pa.Table)]
    assert len(good) > 1
    assert pa.concat_tables(good).equals(table.slice(0, 100))
    assert [type(part) for part in found[len(good) :]] == [parquet.ParquetDamageError]


def test_a_long_episode_is_written_in_row_groups_that_a_reader_can_hold(tmp_path, small_pieces):
    features = {MICROPHONE: audio_feature(RATE, FPS)}
    with DurableWriter("tests/long", tmp_path / "data", FPS, features) as writer:
        for _ in range(30):
            writer.add_frame({MICROPHONE: np.full(BLOCK, 7, np.int16), "task": "listen"})
        writer.save_episode()
    (path,) = tmp_path.glob("data/data/*/*.parquet")
    file = pq.read_metadata(path)
    rows = [file.row_group(i).num_rows for i in range(file.num_row_groups)]
    assert sum(rows) == 30
    assert max(rows) * 2 * BLOCK <= parquet.PIECE_BYTES


@pytest.mark.parametrize("episodes", [None, [0, 2]])
@pytest.mark.parametrize("use_videos", [False, True], ids=["image", "video"])
def test_a_dataset_with_long_episodes_is_read_as_lerobot_reads_it(tmp_path, monkeypatch, use_videos, episodes):
    make_dataset(tmp_path / "data", use_videos=use_videos, image_size=16)
    stock = EpisodeStore.load("tests/noise", str(tmp_path / "data"), episodes, device="cpu", video_backend="pyav")
    monkeypatch.setattr(opening, "_LARGE_ROW_GROUP", 1000)
    assert isinstance(open_dataset("tests/noise", tmp_path / "data"), LongDataset)
    ours = EpisodeStore.load("tests/noise", str(tmp_path / "data"), episodes, device="cpu", video_backend="pyav")
    assert ours.keys == stock.keys
    assert (ours.starts, ours.ends, ours.tasks, ours.fps) == (stock.starts, stock.ends, stock.tasks, stock.fps)
    for key in stock.keys:
        assert torch.equal(ours.column(key), stock.column(key)), key


def test_the_film_of_a_very_long_episode_is_coarser_so_that_a_browser_can_hold_it(tmp_path):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (120, 160, 3), dtype=np.uint8) for _ in range(90)]
    sizes = [
        encode(tmp_path / f"{limit}.mp4", iter(pictures), 90, FPS, [], 1.0, limit).stat().st_size
        for limit in (2**28, 300_000)
    ]
    assert sizes[0] > 2 * 300_000
    assert sizes[1] < 1.5 * 300_000
