"""What corrections of Pick and Place, or of Occluded Grasp, show: a whole search with its hop, or only what comes after it.

    python -m experiments.hops outputs/experiments/datasets/interactive-OccludedPickPlace-v1-*

A correction holds a hop if in it the gripper is told to close at least `AFTER` frames after its beginning, and to be open in
the `OPEN` frames before that. One that begins with the gripper told to close mends what comes after the grasp.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from experiments.protocol import RESULTS, save
from lerobot_playbyear.dagger.batches import stretches

AFTER, OPEN = 40, 30
"""Frames, at 20 a second."""
_BEGINS = 5  # frames that say whether a correction begins with the gripper told to close


@dataclass
class Shown:
    """What the corrections of a dataset show.

    Attributes:
        dataset: Its folder's name.
        corrections, hops, closed: How many there are, that hold a hop, and that begin with the gripper told to close.
        frames: Of the expert.
    """

    dataset: str
    corrections: int = 0
    hops: int = 0
    closed: int = 0
    frames: int = 0


def shown_in(folder: Path) -> Shown:
    """Counts what a dataset's corrections show. One that is a demonstration counts as one correction."""
    paths = sorted((folder / "data").rglob("*.parquet"))
    columns = [pq.read_table(path, columns=["episode_index", "intervention", "action"]) for path in paths]
    episodes = np.concatenate([table["episode_index"].to_numpy() for table in columns])
    by_expert = np.concatenate([table["intervention"].to_numpy(zero_copy_only=False).ravel() for table in columns])
    closes = np.concatenate([np.stack(table["action"].to_pylist())[:, -1] > 0 for table in columns])
    shown = Shown(folder.name)
    for episode in np.unique(episodes):
        here = episodes == episode
        for begin, end in stretches(by_expert[here].astype(bool)):
            gripper = closes[here][begin:end]
            shown.corrections += 1
            shown.frames += len(gripper)
            shown.hops += holds_a_hop(gripper)
            shown.closed += bool(gripper[:_BEGINS].mean() > 0.5)
    return shown


def holds_a_hop(closes: np.ndarray) -> bool:
    """Whether the gripper, (T,) bool, is told to close late, and after it was open for long."""
    begins = np.flatnonzero(closes[1:] & ~closes[:-1]) + 1
    return any(begin >= AFTER and not closes[begin - OPEN : begin].any() for begin in begins)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS / "hops.json")
    options = parser.parse_args()
    found = [shown_in(folder) for folder in options.folders if (folder / "data").is_dir()]
    known = (
        {each["dataset"]: each for each in json.loads(options.output.read_text())} if options.output.exists() else {}
    )
    save(options.output, list((known | {each.dataset: asdict(each) for each in found}).values()), indent=1)
    for each in found:
        print(each)


if __name__ == "__main__":
    main()
