"""A policy that looks at a microphone's picture, played without a clock: nothing is late, nothing passes a sound card.

    python -m experiments.act_camera outputs/act/crop/train/checkpoints/004000/pretrained_model --episodes=20
    python -m experiments.act_camera outputs/act/crop/train/checkpoints/004000/pretrained_model --episodes=12 --twin

The spectrogram is drawn by the camera's own code from the environment's sound. Strip and timecode are left black: it suits
policies whose preprocessor cuts them away (`experiments.act_start --crop`). With `--twin` the hand passes through the hidden
cube, and nothing is heard: a hand that closes there did not wait for the touch.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors

from lerobot_playbyear.audio.microphone_pictures import n_rows
from lerobot_playbyear.audio.sound_picture import RollingSpectrogram
from lerobot_playbyear.microphones.camera import MicrophoneCameraConfig

RATE = 16000
_ROOM_S = 3.0  # heard before the episode


class Player:
    """The policy in the simulated scene.

    Args:
        checkpoint: A policy with `observation.images.gripper` of a microphone and `observation.images.front` of a camera.
        twin: Whether there is nothing to touch.
    """

    def __init__(self, checkpoint: Path, twin: bool) -> None:
        config = PreTrainedConfig.from_pretrained(checkpoint)
        self.policy = get_policy_class(config.type).from_pretrained(checkpoint).eval()
        device = {"device_processor": {"device": "cpu"}}
        self.before, self.after = make_pre_post_processors(
            config, pretrained_path=str(checkpoint), preprocessor_overrides=device
        )
        _, self.height, self.width = config.input_features["observation.images.gripper"].shape
        pixels = config.input_features["observation.images.front"].shape[-1]
        self.env: Any = gym.make(
            "gym_playbyear:gym_playbyear/OccludedGrasp-v1",
            disable_env_checker=True,
            image_size=pixels,
            sample_rate=RATE,
            hidden_object=not twin,
        ).unwrapped

    @torch.inference_mode()
    def play(self, seed: int) -> dict[str, Any]:
        """One episode: how it ended, after how many steps, and how often the hand closed."""
        look = MicrophoneCameraConfig(file="unused.wav", sample_rate=RATE)
        rows = self.height - n_rows(RATE, self.width)
        spectrogram = RollingSpectrogram(RATE, rows, self.width, look.low_db, look.high_db)
        observation, _ = self.env.reset(seed=seed)
        room = observation["audio.gripper"]
        heard, steps, is_over, info = np.tile(room, round(_ROOM_S * RATE / len(room))), 0, False, {}
        self.policy.reset()
        while not is_over:
            picture = np.zeros((self.height, self.width, 3), np.uint8)
            grey = spectrogram.draw(len(heard), lambda first, end, heard=heard: heard[first:end])
            picture[:rows] = grey[:, :, None]
            batch = {
                "observation.state": torch.from_numpy(observation["agent_pos"]).float()[None],
                "observation.images.front": as_batch(observation["pixels"]["front"]),
                "observation.images.gripper": as_batch(picture),
            }
            action = self.after(self.policy.select_action(self.before(batch)))[0].numpy()
            observation, _, terminated, truncated, info = self.env.step(action)
            heard, steps, is_over = (
                np.concatenate([heard, observation["audio.gripper"]]),
                steps + 1,
                terminated or truncated,
            )
        return {"seed": seed, "end": info["end"], "steps": steps, "closings": int(info["n_closings"])}


def as_batch(picture: np.ndarray) -> torch.Tensor:
    """(H, W, 3) uint8 -> (1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float() / 255


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=70000, help="of the first scene; 70000 to 70099 are held out")
    parser.add_argument("--twin", action="store_true")
    given = parser.parse_args()
    player = Player(given.checkpoint, given.twin)
    episodes = [player.play(seed) for seed in range(given.seed, given.seed + given.episodes)]
    ends = [episode["end"] for episode in episodes]
    closed = sum(episode["closings"] > 0 for episode in episodes)
    line = {"step": "act_camera", "twin": given.twin, "scenes": len(episodes), "successes": ends.count("success")}
    print(json.dumps(line | {"closed": closed, "ends": {end: ends.count(end) for end in sorted(set(ends))}}))


if __name__ == "__main__":
    main()
