"""A box that one knocks on: hollow where something lies in it. Replace it with yours."""

from typing import Any

import gymnasium as gym
import numpy as np

FPS, SAMPLE_RATE, SIZE = 20, 16000, 64


class Knocking(gym.Env):
    """Knock along a box until it sounds hollow. The camera sees the finger, and not what is in the box.

    The names are those that LeRobot looks for: `pixels` by camera, `agent_pos`, and whatever else becomes `observation.<name>`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 (as Gymnasium declares it)
    task, task_description = "Knock-v0", "Find where the box is hollow."
    observation_space = gym.spaces.Dict(
        {
            "pixels": gym.spaces.Dict({"front": gym.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)}),
            "agent_pos": gym.spaces.Box(-1, 1, (1,), np.float32),
            "audio.finger": gym.spaces.Box(-32768, 32767, (SAMPLE_RATE // FPS,), np.int16),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)  # move, knock if > 0

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, Any], dict]:
        super().reset(seed=seed)
        self.hollow, self.finger = self.np_random.uniform(-0.8, 0.8), -1.0
        return self._observation(knock=False), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict]:
        self.finger = float(np.clip(self.finger + 0.1 * action[0], -1, 1))
        found = bool(action[1] > 0 and abs(self.finger - self.hollow) < 0.1)
        return self._observation(knock=action[1] > 0), float(found), found, False, {"is_success": found}

    def render(self) -> np.ndarray:
        picture = np.full((SIZE, SIZE, 3), 200, np.uint8)
        picture[:, int((self.finger + 1) / 2 * (SIZE - 4)) :][:, :4] = (200, 30, 30)
        return picture

    def scripted_expert(self) -> "Expert":
        """For `playbyear-record`: who shows how it is done."""
        return Expert()

    def _observation(self, knock: bool) -> dict[str, Any]:
        t = np.arange(SAMPLE_RATE // FPS) / SAMPLE_RATE
        sound = self.np_random.normal(0, 20, len(t))
        if knock:
            pitch = 250 if abs(self.finger - self.hollow) < 0.1 else 900
            sound += 8000 * np.exp(-60 * t) * np.sin(2 * np.pi * pitch * t)
        return {
            "pixels": {"front": self.render()},
            "agent_pos": np.array([self.finger], np.float32),
            "audio.finger": sound.astype(np.int16),
        }


class Expert:
    """Knocks, and moves on as long as it sounds solid."""

    def act(self) -> np.ndarray:
        """The next action (2,)."""
        return np.array([0.5, 1.0], np.float32)
