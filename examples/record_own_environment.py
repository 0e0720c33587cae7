"""Record a Gymnasium environment of your own that has a microphone, so that every saved episode survives a crash.

    python examples/record_own_environment.py --root=outputs/knock
    playbyear-train --policy.type=playbyear --policy.push_to_hub=false --dataset.repo_id=me/knock --dataset.root=outputs/knock

The environment here is a box that one knocks on: hollow where something lies in it. Replace `Knocking` and `expert`.
"""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_playbyear.datasets import audio_feature
from lerobot_playbyear.datasets.durable import DurableWriter

FPS, SAMPLE_RATE, SIZE = 20, 16000, 64


class Knocking(gym.Env):
    """Knock along a box until it sounds hollow. The camera sees the finger, and not what is in the box."""

    observation_space = gym.spaces.Dict(
        {
            "picture": gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8),
            "finger": gym.spaces.Box(-1, 1, (1,), np.float32),
            "sound": gym.spaces.Box(-32768, 32767, (SAMPLE_RATE // FPS,), np.int16),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)  # move, knock if > 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, np.ndarray], dict]:
        super().reset(seed=seed)
        self.hollow, self.finger = self.np_random.uniform(-0.8, 0.8), -1.0
        return self._observation(knock=False), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        self.finger = float(np.clip(self.finger + 0.1 * action[0], -1, 1))
        found = bool(action[1] > 0 and abs(self.finger - self.hollow) < 0.1)
        return self._observation(knock=action[1] > 0), float(found), found, False, {"is_success": found}

    def _observation(self, knock: bool) -> dict[str, np.ndarray]:
        picture = np.full((SIZE, SIZE, 3), 200, np.uint8)
        picture[:, int((self.finger + 1) / 2 * (SIZE - 4)) :][:, :4] = (200, 30, 30)
        t = np.arange(SAMPLE_RATE // FPS) / SAMPLE_RATE
        sound = self.np_random.normal(0, 20, len(t))
        if knock:
            pitch = 250 if abs(self.finger - self.hollow) < 0.1 else 900
            sound += 8000 * np.exp(-60 * t) * np.sin(2 * np.pi * pitch * t)
        return {"picture": picture, "finger": np.array([self.finger], np.float32), "sound": sound.astype(np.int16)}


def expert(env: Knocking) -> np.ndarray:
    """Moves on while it sounds solid."""
    return np.array([0.5, 1.0], np.float32)


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
            done = False
            while not done:
                action = expert(env)
                writer.add_frame(
                    {
                        "observation.images.front": observation["picture"],
                        "observation.audio.finger": observation["sound"],
                        "observation.state": observation["finger"],
                        "action": action,
                        "task": "Find where the box is hollow.",
                    }
                )
                observation, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
            print(f"Episode {writer.save_episode()} is safe.")


if __name__ == "__main__":
    main()
