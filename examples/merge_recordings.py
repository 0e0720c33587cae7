"""Merge recordings that were made with the same settings into one dataset, with LeRobot's own function.

    python examples/merge_recordings.py --roots outputs/monday outputs/tuesday --root=outputs/week --repo_id=me/week

`lerobot-edit-dataset --operation.type=merge` does the same from the command line. The sound stays bit for bit.
"""

import argparse
from pathlib import Path

from lerobot.datasets import LeRobotDataset
from lerobot.datasets.aggregate import aggregate_datasets

from lerobot_playbyear.datasets import audio_keys


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--roots", type=Path, nargs="+", required=True, help="the recordings, in their order")
    parser.add_argument("--root", type=Path, required=True, help="a new folder")
    parser.add_argument("--repo_id", required=True)
    args = parser.parse_args()

    aggregate_datasets([f"local/{i}" for i in range(len(args.roots))], args.repo_id, args.roots, args.root)
    merged = LeRobotDataset(args.repo_id, root=args.root, video_backend="pyav")
    microphones = ", ".join(audio_keys(merged.meta.features))
    print(f"{args.root}: {merged.num_episodes} episodes, {merged.num_frames} frames, {microphones}")


if __name__ == "__main__":
    main()
