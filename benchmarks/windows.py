"""Windows per second out of memory, beside stock `LeRobotDataset`, and the memory that a store takes.

    python benchmarks/windows.py                                    # pictures that move, 84 px, 16 kHz, 20 Hz
    python benchmarks/windows.py --root outputs/demos --repo_id me/demos

Three ways to batches of the same windows, in turns: LeRobot's (`LeRobotDataset[i]`, collated, in this process), the store
returning exactly those tensors, and the store as training uses it: bytes and 16-bit sound, and of each key only the frames
that the policy looks at. The limit is copying as many bytes. Peak memory is the process's own while it reads the dataset into a
store, above what it has when the dataset is open.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from common import Row, in_turns, medians, occupied, parser_for, run
from lerobot.datasets import LeRobotDataset
from scenes import dataset_features, frames
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_playbyear.datasets import EpisodeStore, audio_keys
from lerobot_playbyear.datasets.durable import DurableWriter
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig

WANTED_TIMES, WANTED_MEMORY = 100, 1.2
_BATCH = 32  # windows


def record(root: Path, args: argparse.Namespace) -> None:
    """Writes a dataset with one camera and one microphone."""
    features = dataset_features((args.image_size, args.image_size), args.sample_rate, args.fps)
    with DurableWriter(args.repo_id, root, args.fps, features) as writer:
        for episode in range(args.episodes):
            for frame in frames(features, args.frames, seed=episode):
                writer.add_frame(frame)
            writer.save_episode()


def with_peak[T](work: Callable[[], T]) -> tuple[T, int]:
    """What a piece of work returns, and the most memory of its own that this process needs for it [bytes]; Linux.

    Pages of files that are mapped into memory do not count: the system takes them back when it needs them.
    """
    process = psutil.Process()
    sizes = [occupied(process)[1]]
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(work)
        while not done.done():
            time.sleep(0.002)
            sizes.append(occupied(process)[1])
    return done.result(), max(sizes) - sizes[0]


def drawing(make_batch: Callable[[list[int]], Any], n_frames: int, n_batches: int) -> Callable[[], None]:
    """Work: some batches of random windows."""
    rng = np.random.default_rng(1)

    def draw() -> None:
        for _ in range(n_batches):
            make_batch(rng.integers(n_frames, size=_BATCH).tolist())

    return draw


def measure(args: argparse.Namespace) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        if args.root is not None:
            return measure_reading(args.root, args)
        root = Path(folder) / "dataset"
        # in another process, whose memory does not count
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
            pool.submit(record, root, args).result()
        return measure_reading(root, args)


def measure_reading(root: Path, args: argparse.Namespace) -> list[Row]:
    opened = LeRobotDataset(args.repo_id, root, video_backend="pyav")
    store, peak = with_peak(lambda: EpisodeStore.from_dataset(opened, device="cpu"))

    policy = PlaybyearConfig(sample_rate=args.sample_rate, device="cpu")
    keys = [key for key in store.keys if key.startswith("observation.") or key == "action"]
    full = dict.fromkeys(keys, range(1 - args.window, 1))
    timestamps = {key: [delta / opened.fps for delta in deltas] for key, deltas in full.items()}
    stock = LeRobotDataset(args.repo_id, root, delta_timestamps=timestamps, video_backend="pyav")
    lengths = dict.fromkeys(keys, policy.memory_steps + policy.frame_stack - 1)
    lengths |= dict.fromkeys(audio_keys(store.keys), args.window)
    compact = {key: range(1 - length, 1) for key, length in lengths.items()}
    batch = store.windows(range(_BATCH), compact)
    n_bytes = sum(value.nbytes for value in batch.values() if isinstance(value, Tensor))
    source, target = np.random.default_rng(0).integers(0, 256, (2, 64 * n_bytes), np.uint8)

    n_batches = {"same": 4, "compact": 100, "copy": 64, "stock": 1}
    works: dict[str, Callable[[], object]] = {
        "stock": drawing(lambda i: default_collate([stock[j] for j in i]), len(stock), n_batches["stock"]),
        "same": drawing(lambda i: store.windows(i, full, as_lerobot=True), len(stock), n_batches["same"]),
        "compact": drawing(lambda i: store.windows(i, compact), len(stock), n_batches["compact"]),
        "copy": lambda: np.copyto(target, source),
    }
    seconds = medians(in_turns(works, args.turns))
    rates = {name: n * _BATCH / seconds[name] for name, n in n_batches.items()}
    what = f"dataset windows, {args.window} frames, "
    beside = {"beside": "stock LeRobotDataset", "theirs": rates["stock"]}
    return [
        Row(
            what + "as training uses them",
            rates["compact"],
            "windows/s",
            **beside,
            limit_is="copying as many bytes",
            limit=rates["copy"],
            wanted=f"at least {WANTED_TIMES} times",
            holds=rates["compact"] >= WANTED_TIMES * rates["stock"],
        ),
        Row(what + "LeRobot's very tensors", rates["same"], "windows/s", **beside),
        Row(
            f"peak memory of reading {store.n_episodes} episodes",
            peak / 2**20,
            "MiB",
            limit_is="their raw bytes",
            limit=store.nbytes / 2**20,
            wanted=f"at most {WANTED_MEMORY} times the raw bytes",
            holds=peak <= WANTED_MEMORY * store.nbytes,
        ),
    ]


if __name__ == "__main__":
    parser = parser_for(__doc__, turns=5)
    parser.add_argument("--root", type=Path, help="folder of an existing dataset; one is recorded without it")
    parser.add_argument("--repo_id", default="benchmark/windows", help="name of that dataset")
    parser.add_argument("--image_size", type=int, default=84, help="pixels")
    parser.add_argument("--sample_rate", type=int, default=16000, help="Hz")
    parser.add_argument("--fps", type=int, default=20, help="Hz")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--frames", type=int, default=100, help="per episode")
    parser.add_argument("--window", type=int, default=49, help="frames: 2 s of sound before a window of 10")
    run("windows", parser, measure)
