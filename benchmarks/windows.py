"""Windows per second out of memory, beside stock `LeRobotDataset`.

    python benchmarks/windows.py

Pictures that move, of 84 px, sound of 16 kHz, 20 Hz. Two ways to batches of the same windows, in turns: LeRobot's
(`LeRobotDataset[i]`, collated, in this process), and the store as training uses it: bytes and 16-bit sound, and of each key
only the frames that the policy looks at. The limit is copying as many bytes.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import Row, dataset_features, in_turns, medians, parser_for, record, run
from lerobot.datasets import LeRobotDataset
from torch import Tensor
from torch.utils.data import default_collate

from lerobot_playbyear.datasets import audio_keys
from lerobot_playbyear.policy.configuration_playbyear import PlaybyearConfig
from lerobot_playbyear.training import EpisodeStore

REPO_ID = "benchmark/windows"
SAMPLE_RATE, FPS, PIXELS = 16000, 20, 84
WINDOW = 49  # frames: 2 s of sound before a window of 10
_BATCH = 32  # windows


def drawing(make_batch: Callable[[list[int]], Any], n_frames: int, n_batches: int) -> Callable[[], None]:
    """Work: some batches of random windows."""
    rng = np.random.default_rng(1)

    def draw() -> None:
        for _ in range(n_batches):
            make_batch(rng.integers(n_frames, size=_BATCH).tolist())

    return draw


def measure(args: argparse.Namespace) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        root, features = Path(folder) / "dataset", dataset_features((PIXELS, PIXELS), SAMPLE_RATE, FPS)
        record(root, REPO_ID, FPS, features, [100] * 50)
        return measure_reading(root, args.turns)


def measure_reading(root: Path, turns: int) -> list[Row]:
    opened = LeRobotDataset(REPO_ID, root, video_backend="pyav")
    store = EpisodeStore.from_dataset(opened, device="cpu")
    policy = PlaybyearConfig(sample_rate=SAMPLE_RATE, device="cpu")
    keys = [key for key in store.keys if key.startswith("observation.") or key == "action"]
    full = dict.fromkeys(keys, range(1 - WINDOW, 1))
    timestamps = {key: [delta / opened.fps for delta in deltas] for key, deltas in full.items()}
    stock = LeRobotDataset(REPO_ID, root, delta_timestamps=timestamps, video_backend="pyav")
    lengths = dict.fromkeys(keys, policy.memory_steps + policy.frame_stack - 1)
    lengths |= dict.fromkeys(audio_keys(store.keys), WINDOW)
    compact = {key: range(1 - length, 1) for key, length in lengths.items()}
    batch = store.windows(range(_BATCH), compact)
    n_bytes = sum(value.nbytes for value in batch.values() if isinstance(value, Tensor))
    source, target = np.random.default_rng(0).integers(0, 256, (2, 64 * n_bytes), np.uint8)

    n_batches = {"compact": 100, "copy": 64, "stock": 1}
    works: dict[str, Callable[[], object]] = {
        "stock": drawing(lambda i: default_collate([stock[j] for j in i]), len(stock), n_batches["stock"]),
        "compact": drawing(lambda i: store.windows(i, compact), len(stock), n_batches["compact"]),
        "copy": lambda: np.copyto(target, source),
    }
    seconds = medians(in_turns(works, turns))
    rates = {name: n * _BATCH / seconds[name] for name, n in n_batches.items()}
    what, beside = f"dataset windows, {WINDOW} frames, ", ("windows/s", "stock LeRobotDataset", rates["stock"])
    return [Row(what + "as training uses them", rates["compact"], *beside, "copying as many bytes", rates["copy"])]


if __name__ == "__main__":
    run(parser_for(__doc__, turns=5), measure)
