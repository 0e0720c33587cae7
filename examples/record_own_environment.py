"""Record a Gymnasium environment of your own that has a microphone, so that every saved episode survives a crash.

    python examples/record_own_environment.py --root=outputs/knock
    playbyear-train --preset=cpu --dataset.repo_id=me/knock --dataset.root=outputs/knock --output_dir=outputs/train/knock

The environment here is a box that one knocks on: hollow where something lies in it (`gym_knock/environment.py`). Replace it and
its expert. With the few lines of `gym_knock/configuration.py` LeRobot's commands know the environment, and `playbyear-record`
does what this program does.
"""

import argparse
from pathlib import Path
from typing import Any

from gym_knock import Knocking
from gym_knock.environment import FPS, SAMPLE_RATE, SIZE

from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.durable import DurableWriter

FEATURES: dict[str, dict[str, Any]] = {
    "observation.images.front": {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]},
    "observation.audio.finger": audio_feature(SAMPLE_RATE, FPS),
    "observation.state": {"dtype": "float32", "shape": (1,), "names": ["finger"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["move", "knock"]},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=5)
    args = parser.parse_args()

    env = Knocking()
    with DurableWriter("me/knock", args.root, FPS, FEATURES, resume=True) as writer:
        while writer.num_episodes < args.episodes:
            observation, _ = env.reset(seed=writer.num_episodes)
            expert = env.scripted_expert()
            done = False
            while not done:
                action = expert.act()
                writer.add_frame(
                    {
                        "observation.images.front": observation["pixels"]["front"],
                        "observation.audio.finger": observation["audio.finger"],
                        "observation.state": observation["agent_pos"],
                        "action": action,
                        "task": env.task_description,
                    }
                )
                observation, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
            print(f"Episode {writer.save_episode()} is safe.")


if __name__ == "__main__":
    main()
