"""Processes that are killed while they fill the disk store; see `test_store.py`.

Forks a child for each kill, and at last one that says whether the store holds what the dataset does.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import torch

from lerobot_playbyear.datasets.reader import DatasetReader
from lerobot_playbyear.training import EpisodeStore

IMAGE_SIZE = 24


def build(root: str, cache: str, **options: object) -> EpisodeStore:
    """The dataset's store."""
    place = {"place": "disk", "cache": Path(cache), "image_size": IMAGE_SIZE, **options}
    return EpisodeStore.from_dataset(DatasetReader("tests/noise", root), device="cpu", **place)


def forked(task) -> tuple[int, float]:
    """Begins a task in a child: its number, and when."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        try:
            task()
        finally:
            os._exit(0)
    return child, time.monotonic()


def main() -> None:
    root, cache, n_kills, seed = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    draw = random.Random(seed)
    child, began = forked(lambda: build(root, f"{cache}-undisturbed"))
    os.waitpid(child, 0)
    took = time.monotonic() - began
    finished_early = 0
    for _ in range(n_kills):
        child, _ = forked(lambda: build(root, cache))
        time.sleep(draw.uniform(0.1, 0.6) * took)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        finished_early += not os.WIFSIGNALED(status)

    def compare() -> None:
        store, undisturbed = build(root, cache), build(root, cache, place="memory")
        wrong = [key for key in store.keys if not torch.equal(store.column(key), undisturbed.column(key))]
        print(json.dumps({"wrong": wrong, "frames": len(store), "finished_early": finished_early}), flush=True)

    os.waitpid(forked(compare)[0], 0)


if __name__ == "__main__":
    main()
