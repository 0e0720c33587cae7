"""The policy on a dataset of another shape: two cameras of different sizes, two microphones at 48 kHz, 30 frames per
second, and other state and action sizes. Here the frames are noise; replace `frames` with your robot's.

    python examples/own_robot.py --root=outputs/own_robot
    playbyear-train --policy.type=playbyear --policy.push_to_hub=false --policy.fps=30 \
        --dataset.repo_id=me/own_robot --dataset.root=outputs/own_robot
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset

from lerobot_playbyear.datasets import audio_feature

FPS, SAMPLE_RATE = 30, 48000
IMAGE_NAMES = ["height", "width", "channels"]
FEATURES: dict[str, dict[str, Any]] = {
    "observation.images.front": {"dtype": "image", "shape": (96, 128, 3), "names": IMAGE_NAMES},
    "observation.images.wrist": {"dtype": "image", "shape": (64, 64, 3), "names": IMAGE_NAMES},
    "observation.audio.gripper": audio_feature(SAMPLE_RATE, FPS),
    "observation.audio.table": audio_feature(SAMPLE_RATE, FPS),
    "observation.state": {"dtype": "float32", "shape": (9,), "names": None},
    "observation.wrench": {"dtype": "float32", "shape": (6,), "names": None},
    "action": {"dtype": "float32", "shape": (7,), "names": None},
}


def frames(n_frames: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """One episode's frames: the observation, and the action taken upon it."""
    for _ in range(n_frames):
        frame: dict[str, Any] = {"task": "find it by ear"}
        for key, feature in FEATURES.items():
            if feature["dtype"] == "image":
                frame[key] = rng.integers(0, 256, feature["shape"], dtype=np.uint8)
            elif feature["dtype"] == "int16":
                frame[key] = rng.integers(-3000, 3000, feature["shape"], dtype=np.int16)
            else:
                frame[key] = rng.uniform(-1, 1, feature["shape"]).astype(np.float32)
        yield frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--frames", type=int, default=80)
    args = parser.parse_args()

    dataset = LeRobotDataset.create(
        "me/own_robot", fps=FPS, root=args.root, features=FEATURES, use_videos=False, video_backend="pyav"
    )
    rng = np.random.default_rng(0)
    for _ in range(args.episodes):
        for frame in frames(args.frames, rng):
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    print(f"{args.root}: {dataset.num_episodes} episodes, {dataset.num_frames} frames")


if __name__ == "__main__":
    main()
