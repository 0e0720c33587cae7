"""Windows per second: `EpisodeStore` against `LeRobotDataset`, on the same frames.

    python benchmarks/windows.py                                    # noise: 84x84 images, 16 kHz, 20 Hz
    python benchmarks/windows.py --root outputs/demos --repo-id me/demos --output windows.json

Three ways to the same batches: LeRobot's loader (`LeRobotDataset[i]`, collated, in this process), the store returning
exactly those tensors, and the store as training uses it: bytes and 16-bit sound, and of each key only the frames that
the policy looks at. The lines give windows per second and how many times faster than LeRobot's loader that is.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from torch.utils.data import default_collate

from lerobot_playbyear.datasets import EpisodeStore, audio_feature, audio_keys

MIN_SECONDS = 3.0


def record_noise(root: Path, args: argparse.Namespace) -> None:
    """Write a dataset of noise with one camera and one microphone."""
    shape = (args.image_size, args.image_size, 3)
    kind = "video" if args.video else "image"
    features = {
        "observation.images.front": {"dtype": kind, "shape": shape, "names": ["height", "width", "channels"]},
        "observation.audio.gripper": audio_feature(args.sample_rate, args.fps),
        "observation.state": {"dtype": "float32", "shape": (7,), "names": None},
        "action": {"dtype": "float32", "shape": (4,), "names": None},
    }
    dataset = LeRobotDataset.create(args.repo_id, args.fps, features, root=root, use_videos=args.video)
    rng = np.random.default_rng(0)
    n_samples = features["observation.audio.gripper"]["shape"][0]
    for _ in range(args.episodes):
        for _ in range(args.frames):
            dataset.add_frame(
                {
                    "observation.images.front": rng.integers(0, 256, shape, dtype=np.uint8),
                    "observation.audio.gripper": rng.normal(0, 300, n_samples).astype(np.int16),
                    "observation.state": rng.normal(size=7).astype(np.float32),
                    "action": rng.normal(size=4).astype(np.float32),
                    "task": "noise",
                }
            )
        dataset.save_episode()
    dataset.finalize()


def windows_per_second(make_batch: Callable[[list[int]], Any], n_frames: int, batch_size: int) -> float:
    """Make batches of random windows for a few seconds, after one to warm up."""
    rng = np.random.default_rng(1)
    make_batch(rng.integers(n_frames, size=batch_size).tolist())
    n_windows, start = 0, time.perf_counter()
    while time.perf_counter() - start < MIN_SECONDS:
        make_batch(rng.integers(n_frames, size=batch_size).tolist())
        n_windows += batch_size
    return n_windows / (time.perf_counter() - start)


def measure(root: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Time the three ways on the dataset in `root`."""
    keys = [
        key for key in LeRobotDataset(args.repo_id, root).features if key.startswith("observation.") or key == "action"
    ]
    full = {key: range(1 - args.window, 1) for key in keys}
    fps = LeRobotDataset(args.repo_id, root).fps
    timestamps = {key: [delta / fps for delta in deltas] for key, deltas in full.items()}
    stock = LeRobotDataset(args.repo_id, root, delta_timestamps=timestamps)

    start = time.perf_counter()
    store = EpisodeStore.from_dataset(stock, device=args.device, progress=True)
    read_s = time.perf_counter() - start
    lengths = dict.fromkeys(keys, args.run) | dict.fromkeys(audio_keys(store.keys), args.window)
    compact = {key: range(1 - n, 1) for key, n in lengths.items()}

    n, batch_size = len(stock), args.batch_size
    rates = {
        "lerobot": windows_per_second(lambda i: default_collate([stock[j] for j in i]), n, batch_size),
        "store_same_tensors": windows_per_second(lambda i: store.windows(i, full, as_lerobot=True), n, batch_size),
        "store_compact": windows_per_second(lambda i: store.windows(i, compact), n, batch_size),
    }
    return {
        "frames": n,
        "window_frames": args.window,
        "run_frames": args.run,
        "batch_size": batch_size,
        "device": str(store.device),
        "threads": torch.get_num_threads(),
        "store_mib": round(store.nbytes / 2**20, 1),
        "store_read_s": round(read_s, 2),
        "windows_per_s": {key: round(rate, 1) for key, rate in rates.items()},
        "times_faster": {key: round(rate / rates["lerobot"], 1) for key, rate in rates.items() if key != "lerobot"},
    }


def main() -> None:
    """Measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="folder of an existing dataset; noise is recorded without it")
    parser.add_argument("--repo-id", default="benchmark/noise", help="name of that dataset")
    parser.add_argument("--video", action="store_true", help="record the noise as video, not as images")
    parser.add_argument("--image-size", type=int, default=84, help="pixels")
    parser.add_argument("--sample-rate", type=int, default=16000, help="Hz")
    parser.add_argument("--fps", type=int, default=20, help="Hz")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--frames", type=int, default=60, help="per episode")
    parser.add_argument("--window", type=int, default=49, help="frames: 2 s of sound before a run of 10")
    parser.add_argument("--run", type=int, default=12, help="frames of the other keys in the compact batches")
    parser.add_argument("--batch-size", type=int, default=32, help="windows")
    parser.add_argument("--device", help="of the store; the GPU when it fits, otherwise the CPU")
    parser.add_argument("--output", type=Path, help="JSON file for the figures")
    args = parser.parse_args()

    with tempfile.TemporaryDirectory() as folder:
        root = args.root or Path(folder) / "noise"
        if args.root is None:
            record_noise(root, args)
        result = measure(root, args)
    rates, ratios = result["windows_per_s"], result["times_faster"]
    print(f"{result['frames']} frames, {result['store_mib']} MiB, read in {result['store_read_s']} s")
    print(f"LeRobotDataset             {rates['lerobot']:>10.1f} windows/s")
    for key, name in (("store_same_tensors", "EpisodeStore, same tensors"), ("store_compact", "EpisodeStore, compact")):
        print(f"{name:<26} {rates[key]:>10.1f} windows/s  {ratios[key]:>6.1f} times faster")
    print(json.dumps(result))
    if args.output:
        args.output.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
